"""The topics table as Markdown, spliced into ARCHITECTURE.md: ``python -m services.evaluate.architecture``."""

from __future__ import annotations

from pathlib import Path

from schemas.topics import PREFIX, TOPICS, Topic

BEGIN, END = "<!-- topics: generated -->", "<!-- /topics -->"
_COLUMNS = ("key", "message", "from", "to", "rate", "late after", "reach", "delivery", "encoding", "recorded", "what")


def _row(topic: Topic) -> tuple[str, ...]:
    express = ", express" if topic.express else ""
    cache = f" (keeps {topic.cache})" if topic.delivery.value == "advanced" else ""
    return (
        f"`{topic.name}`",
        topic.message.__name__,
        topic.producer,
        ", ".join(topic.consumers),
        f"{topic.rate_hz:g} Hz" if topic.rate_hz else "on change",
        f"{topic.timeout_s:g} s" if topic.timeout_s else "-",
        topic.reach.value,
        f"{topic.delivery.value}{cache}, {topic.priority}{express}",
        f"`{topic.encoding}`",
        "yes" if topic.recorded else "no",
        topic.description,
    )


def render_table() -> str:
    """Return the table of all topics in Markdown."""
    lines = [
        f"Keys stand below `{PREFIX}/{{uav}}/`.",
        "",
        "| " + " | ".join(_COLUMNS) + " |",
        "|" + "---|" * len(_COLUMNS),
    ]
    lines += ["| " + " | ".join(_row(topic)) + " |" for topic in TOPICS]
    return "\n".join(lines)


def spliced(page: str, table: str) -> str:
    """Return the page with the part between the markers replaced by ``table``.

    Raises:
        ValueError: when the page has no markers.
    """
    head, found, rest = page.partition(BEGIN)
    _, closed, tail = rest.partition(END)
    if not (found and closed):
        raise ValueError(f"no {BEGIN} ... {END} in the page")
    return f"{head}{BEGIN}\n{table}\n{END}{tail}"


def main() -> None:
    """Rewrite ARCHITECTURE.md of this checkout."""
    path = Path(__file__).resolve().parents[2] / "ARCHITECTURE.md"
    path.write_text(spliced(path.read_text(), render_table()))


if __name__ == "__main__":
    main()
