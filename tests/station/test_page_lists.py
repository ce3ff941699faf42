"""The page's lists keep no old line: drawn in a real browser, from states that a station would tell one after the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

LINES = """async (what) => {
    const { drawLog, drawSystems } = await import('/static/js/panels.js');
    const { Craft } = await import('/static/js/model.js');
    const read = (id, row) => [...document.querySelectorAll(`#${id} ${row}`)].map((n) => n.innerText ?? n.textContent);
    const event = (number, time_ns, text) => ({ number, time_ns, uav: 'uav1', level: 'info', text });
    const told = [];
    if (what === 'log') {
        document.getElementById('tab-log').click();
        for (const [at, texts] of [[1e18, ['before', 'crash']], [2e18, ['after']]]) {
            drawLog(texts.map((text, k) => event(k + 1, at, text)), 'uav1', false);
            told.push(read('panel-log', 'p'));
        }
        return told;
    }
    document.getElementById('tab-systems').click();
    const craft = new Craft('uav1'), lease = (id, left) => ({ id, uav: 'uav1', kind: 'place', tree: null, left });
    craft.take({ uav: 'uav1', link: 'good', link_age: 0, topics: [], services: [], fusion: null }, performance.now());
    for (const leases of [[lease(7, 3)], [lease(7, 2), lease(8, 40)], [lease(7, 1), lease(8, 39)], [lease(8, 38)]]) {
        drawSystems(craft, performance.now(), { leases, visited: 0, waits: 0 });
        told.push(read('panel-systems', '.note:not([hidden])').filter((t) => t.includes('left')));
    }
    return told;
}"""
"""Draws one state after the other, the page's own drawing left aside, and returns the lines of each."""


def test_a_restarted_station_numbers_its_log_anew_and_the_page_shows_the_new_lines(page: Page) -> None:
    assert page.evaluate(LINES, "log") == [["crash", "before"], ["after"]]


def test_each_claim_has_one_line_and_ends_with_it(page: Page) -> None:
    assert page.evaluate(LINES, "claims") == [
        ["3 s left"],
        ["2 s left", "40 s left"],
        ["1 s left", "39 s left"],
        ["38 s left"],
    ]


def test_a_list_keeps_no_line_that_is_not_in_it_even_when_two_have_one_key(page: Page) -> None:
    drawn = page.evaluate("""async () => {
        const { el, keyed, text } = await import('/static/js/dom.js');
        const list = el('div'), told = [];
        for (const items of [['a', 'b'], ['a1', 'a2', 'b'], ['a1', 'a2', 'b'], ['b', 'a'], []]) {
            keyed(list, items, (i) => i[0], () => el('p'), (node, i) => text(node, i));
            told.push([...list.children].map((n) => n.textContent));
        }
        return told;
    }""")
    assert drawn == [["a", "b"], ["a1", "a2", "b"], ["a1", "a2", "b"], ["b", "a"], []]
