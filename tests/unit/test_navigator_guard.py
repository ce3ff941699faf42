"""The live guard: what the depth image shows, what is remembered of the space, what moves, and what is done about it."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from services.common.geometry import level_camera, rotation_z
from services.evaluate.eyes import Round, see
from services.navigator.config import NavigatorConfig
from services.navigator.guard import Sweep, free_way_m, look
from services.navigator.moving import Mover, Movers, clusters, conflict
from services.navigator.path import Disc, plan
from services.navigator.space import Space
from services.navigator.track import Correction
from tests.unit.navigator_world import World, tree

# -- live guard ---------------------------------------------------------------------------------------------------

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
SWEEP = Sweep(0.45, 0.25, 0.45)


def _scene(*pillars: tuple[float, float, float]) -> np.ndarray:
    """Depth (mm) of upright pillars: forward m, left m, radius m, on nothing."""
    depth = np.zeros((480, 640), dtype=np.uint16)
    u = np.arange(640)
    for forward, left, radius in sorted(pillars, reverse=True):
        across = -(u - 319.5) / 500.0 * forward
        depth[:, np.abs(across - left) < radius] = round(1000 * forward)
    return depth


def _free(depth: np.ndarray, yaw: float = 0.0, target: tuple[float, float] | None = None) -> float:
    T = level_camera((1.0, 2.0, 3.0), yaw)
    view = look(depth, INTRINSICS, T, 0)
    direction = np.array([np.cos(yaw), np.sin(yaw)])
    return free_way_m(view, direction, None if target is None else np.array(target), SWEEP)


def test_the_guard_sees_what_stands_in_the_box_and_nothing_else() -> None:
    assert _free(_scene()) == float("inf")
    assert _free(_scene((2.0, 0.0, 0.1))) == pytest.approx(2.0)
    assert _free(_scene((2.0, 0.4, 0.1)), yaw=0.7) == pytest.approx(2.0)
    assert _free(_scene((2.0, 0.7, 0.1))) == float("inf")
    assert _free(_scene((2.0, 0.0, 0.1)), target=(2.1, 0.0)) == float("inf")
    assert _free(_scene((2.0, 0.0, 0.1), (1.2, 0.1, 0.05)), target=(2.1, 0.0)) == pytest.approx(1.2)


def test_noise_on_a_few_pixels_is_no_obstacle() -> None:
    depth = _scene()
    depth[228:252, 308:332] = 900  # nine rays of the thinned image
    assert _free(depth) == pytest.approx(0.9)
    depth[:] = 0
    depth[228:236, 308:332] = 900  # three
    assert _free(depth) == float("inf")


def test_the_fan_is_free_up_to_what_stands_and_a_blinded_camera_sees_nothing() -> None:
    ground = np.zeros((480, 640), dtype=np.uint16)
    ground[320:] = 4000
    wall = ground.copy()
    wall[:, 200:280] = 2000
    T = level_camera((1.0, 2.0, 1.5), 0.4)
    fan = look(wall, INTRINSICS, T, 0, ("m", 0)).fan
    assert fan is not None
    column = (np.arange(80) * 8 + 4 - 319.5) / 500.0
    assert fan.azimuth_rad == pytest.approx(0.4 - np.arctan(column))
    behind = (np.arange(80) * 8 + 4 >= 210) & (np.arange(80) * 8 + 4 < 270)
    assert fan.free_m[behind] == pytest.approx(2.0 / np.cos(np.arctan(column[behind])) - 0.1, abs=0.02)
    assert fan.free_m[45:] == pytest.approx(4.0)
    near = ground.copy()
    near[:, 300:400] = 0  # somebody nearer than the sensor can measure
    fan = look(near, INTRINSICS, T, 0, ("m", 0)).fan
    assert fan is not None
    assert (fan.free_m[39:49] == 0.0).all()


def test_points_strewn_behind_an_edge_are_seen_but_not_remembered() -> None:
    depth = np.full((480, 640), 4000, dtype=np.uint16)
    depth[:, 300:340] = 2000
    depth[:, 296:300] = depth[:, 340:344] = 2900  # mixed of trunk and background
    view = look(depth, INTRINSICS, level_camera((0.0, 0.0, 1.5), 0.0), 0, ("m", 0))
    assert view.solid is not None
    ahead = view.points_m[:, 0]
    assert (np.abs(ahead - 2.9) < 0.05).any()
    assert not (np.abs(ahead[view.solid] - 2.9) < 0.05).any()
    assert (np.abs(ahead[view.solid] - 2.0) < 0.05).sum() > 0.5 * (np.abs(ahead - 2.0) < 0.05).sum()


# -- space --------------------------------------------------------------------------------------------------------


def _looked(space: Space, things: list[Round], at: tuple[float, float], yaw: float, times: int = 4) -> None:
    for n in range(times):
        place = np.array([*at, 1.4])
        space.take(see(things, place[:2], yaw, place, yaw, n, ("m", 0)), [])


def test_unknown_until_seen_occupied_where_something_stands_free_again_when_it_left() -> None:
    space = Space()
    ahead = np.array([[2.0, 0.0], [3.5, 0.0], [-2.0, 0.0]])
    assert not space.is_free(ahead).any()
    person = [Round(3.0, 0.0, 0.25)]
    _looked(space, person, (0.0, 0.0), 0.0)
    assert space.is_free(ahead).tolist() == [True, False, False], "before it, behind it, behind us"
    thing = space.things()
    assert len(thing) == 1
    assert np.hypot(thing[0].x_m - 2.8, thing[0].y_m) < 0.2
    _looked(space, [], (0.0, 0.0), 0.0, 16)
    assert space.things() == []
    assert space.is_free(ahead).tolist() == [True, True, False]


def test_where_the_aircraft_was_is_free_and_the_way_is_known_only_so_far() -> None:
    space = Space()
    space.visit(np.array([0.0, 0.0]), 0.8)
    assert space.known_ahead_m(np.zeros(2), np.array([3.0, 0.0]), 0.3) == pytest.approx(0.75, abs=0.2)
    _looked(space, [], (0.0, 0.0), 0.0)
    assert space.known_ahead_m(np.zeros(2), np.array([3.0, 0.0]), 0.3) == pytest.approx(3.0)
    assert space.known_ahead_m(np.zeros(2), np.array([-3.0, 0.0]), 0.3) < 1.0


def test_the_space_follows_a_correction_of_the_map() -> None:
    space = Space()
    _looked(space, [Round(3.0, 0.5, 0.25)], (0.0, 0.0), 0.0)
    before = space.things()[0]
    c = Correction(0.6, np.array([1.0, -2.0, 0.1]))
    space.correct(c)
    after = space.things()[0]
    assert c.point(np.array([before.x_m, before.y_m, 0.0]))[:2] == pytest.approx((after.x_m, after.y_m))
    assert space.is_free(c.point(np.array([2.0, 0.0, 0.0]))[None, :2]).all()
    assert not space.is_free(np.array([[-2.0, 2.0]])).any()


def test_what_the_map_explains_is_no_thing() -> None:
    space, place = Space(), np.array([0.0, 0.0, 1.4])
    for n in range(6):
        view = see([Round(3.0, 0.0, 0.15), Round(2.5, 1.0, 0.2)], place[:2], 0.0, place, 0.0, n, ("m", 0))
        unexplained = space.take(view, [Disc(3.0, 0.0, 0.45)])
    assert len(space.things()) == 1
    assert np.hypot(*(unexplained - [2.5, 1.0]).T).max() < 0.3


def test_a_way_through_what_nobody_saw_is_taken_only_when_it_is_much_shorter() -> None:
    def behind(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(x - 2.0) < 0.5) & (np.abs(y) < 1.0) | (np.abs(x) > 99.0))

    way = plan(np.zeros(2), np.array([4.0, 0.0]), [], None, behind)
    assert way is not None
    assert len(way) > 1
    assert min(abs(float(p[1])) for p in way[:-1]) > 0.8
    assert plan(np.zeros(2), np.array([4.0, 0.0]), [], None, lambda x, y: np.ones((len(x), y.shape[1]), bool))


# -- what moves ---------------------------------------------------------------------------------------------------


def _walk(movers: Movers, start: tuple[float, float], velocity: tuple[float, float], seconds: float) -> int:
    rng = np.random.default_rng(1)
    now_ns = 0
    for n in range(round(seconds * 15)):
        now_ns = round(n * 1e9 / 15)
        middle = np.array(start) + np.array(velocity) * now_ns / 1e9
        movers.take(middle + rng.normal(0.0, 0.08, (20, 2)), now_ns)
    return now_ns


def test_a_walker_is_followed_and_predicted_a_second_ahead() -> None:
    movers = Movers()
    now_ns = _walk(movers, (3.0, -1.5), (0.0, 0.8), 1.5)
    moving = movers.moving(now_ns)
    assert len(moving) == 1
    assert moving[0].state[2:] == pytest.approx((0.0, 0.8), abs=0.2)
    assert moving[0].at(now_ns + 10**9) == pytest.approx((3.0, -1.5 + 0.8 * 2.43), abs=0.3)


def test_what_stands_still_does_not_move_and_is_forgotten_unseen() -> None:
    movers = Movers()
    now_ns = _walk(movers, (3.0, 0.0), (0.0, 0.0), 3.0)
    assert movers.moving(now_ns) == []
    assert len(movers.followed) == 1
    movers.take(np.zeros((0, 2)), now_ns + 1_500_000_000)
    assert movers.followed == []


def test_movers_follow_a_correction() -> None:
    movers = Movers()
    now_ns = _walk(movers, (3.0, 0.0), (0.0, 0.8), 1.5)
    state = movers.followed[0].state.copy()
    c = Correction(0.5, np.array([1.0, 2.0, 0.0]))
    movers.correct(c)
    assert movers.moving(now_ns)[0].state[2:] == pytest.approx((rotation_z(0.5) @ [*state[2:], 0.0])[:2])


def test_two_that_stand_apart_are_two() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.normal((2.0, 0.0), 0.1, (15, 2)), rng.normal((2.0, 1.5), 0.1, (15, 2))])
    assert len(clusters(points)) == 2
    assert clusters(np.zeros((3, 2))) == []


def test_a_conflict_is_one_that_comes_and_not_one_that_leaves() -> None:
    def mover(x: float, y: float, vx: float, vy: float) -> list[Mover]:
        return [Mover(np.array([x, y, vx, vy]), np.eye(4) * 0.01, 0.25, np.zeros(2), 0, 0, 9)]

    here, still, onward = np.zeros(2), np.zeros(2), np.array([0.35, 0.0])
    assert conflict(here, still, mover(1.5, 0.0, -1.0, 0.0), 0, 0.45)
    assert conflict(here, still, mover(2.5, 0.0, -1.0, 0.0), 0, 0.45) is None
    assert conflict(here, onward, mover(1.0, 0.9, 0.0, -0.8), 0, 0.45)
    assert conflict(here, onward, mover(0.6, 0.0, 1.5, 0.0), 0, 0.45) is None


# -- in flight ----------------------------------------------------------------------------------------------------


def _approaching(**config: float) -> World:
    world = World(NavigatorConfig(**config))  # type: ignore[arg-type]
    world.start()
    assert world.run("approach") == "approach"
    world.run(seconds=2.0)
    return world


def _ahead(world: World, metres: float, aside: float = 0.0) -> np.ndarray:
    way = world.mission.board.trajectory.velocity_m_s[:2]
    way = way / np.linalg.norm(way)
    return np.asarray(world.position_m[:2] + metres * way + aside * np.array([-way[1], way[0]]))


def test_a_person_in_the_way_brakes_waits_and_goes_on() -> None:
    world = _approaching()
    world.walkers = [_ahead(world, 1.0)]
    assert world.run("hold", 3.0) == "hold"
    assert "in the way" in world.mission.reason
    world.run(seconds=1.2)
    assert world.state == "hold", "it waits first"
    world.walkers = []
    assert world.run("docked") == "docked"
    assert world.least_m > 0.7


def test_a_person_who_stays_is_gone_round() -> None:
    world = _approaching()
    world.walkers = [_ahead(world, 1.0)]
    assert world.run("hold", 3.0) == "hold"
    assert world.run(("docked", "landing"), 60.0) == "docked", world.mission.reason
    assert world.least_m > 0.70, "half a metre and a person's quarter"


def test_a_person_who_crosses_is_waited_for() -> None:
    world = _approaching()
    world.walkers = [_ahead(world, 1.1, 1.3)]
    world.walker_velocity_m_s = -0.8 * (_ahead(world, 1.1, 1.3) - _ahead(world, 1.1)) / 1.3
    assert world.run(("hold", "docked"), 6.0) == "hold", "brakes before they are in the way"
    assert "moves into the way" in world.mission.reason or "in the way" in world.mission.reason
    assert world.run(("docked", "landing"), 60.0) == "docked", world.mission.reason
    assert world.least_m > 0.6


def test_a_tree_without_a_free_place_before_it_is_given_up() -> None:
    """Bushes all round it, which no map knows: seen on the way, gone round in vain, left alone."""
    world = World(trees=[tree(1, 4.0, 1.0)])
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    world.walkers = [np.array([4.0, 1.0]) + 1.4 * np.array([np.cos(a), np.sin(a)]) for a in angles]
    world.start()
    assert world.run("landing", 240.0) == "landing"
    assert not any(event.after == "docked" for event in world.events)
    assert world.least_m > 0.6


def test_a_tree_that_cannot_be_reached_in_time_is_given_up() -> None:
    world = World(NavigatorConfig(target_timeout_s=12.0, approach_speed_m_s=0.05))
    world.start()
    assert world.run("approach") == "approach"
    world.run("select", 60.0)
    assert "not reached in 12 s" in world.mission.reason


def test_space_that_nobody_has_seen_is_looked_at_before_it_is_flown() -> None:
    """A thick trunk hides what lies behind it; the way round leads there, so the camera turns before the aircraft moves."""
    world = World(trees=[tree(1, 5.0, 0.4), tree(2, 2.4, 0.0, 0.5, suitable=False)])
    world.start()
    assert world.run("approach") == "approach"
    space = world.mission.board.around.space
    for _ in range(round(60.0 / 0.05)):
        here = world.position_m[:2]
        world.step()
        speed = float(np.linalg.norm(world.mission.board.trajectory.velocity_m_s[:2]))
        if world.state == "approach" and speed > 0.15:
            assert space.is_free(here[None]).all()
        if world.state in ("docked", "landing"):
            break
    assert world.state == "docked", world.mission.reason


def test_without_eyes_preflight_refuses() -> None:
    from services.navigator.board import Board
    from services.navigator.preflight import missing

    board = Board(NavigatorConfig())
    assert any("depth images" in word for word in missing(board, board.config))
    assert not any("depth" in word for word in missing(board, NavigatorConfig(live_guard=False)))


def test_it_gives_way_to_somebody_who_comes_too_near() -> None:
    world = _approaching()
    world.walkers = [_ahead(world, 1.6)]
    world.walker_velocity_m_s = -0.5 * (_ahead(world, 1.0) - world.position_m[:2])
    begin = world.position_m[:2].copy()
    world.run("hold", 3.0)
    for _ in range(40):
        world.step()
        if float(np.hypot(*(world.walkers[0] - world.position_m[:2]))) < 0.75:
            break
    world.walker_velocity_m_s = np.zeros(2)
    place = world.position_m[:2].copy()
    world.run(seconds=1.5)
    assert np.hypot(*(world.position_m[:2] - world.walkers[0])) > np.hypot(*(place - world.walkers[0])) + 0.1
    assert np.hypot(*(world.position_m[:2] - begin)) < 1.5


def test_a_view_along_the_way_makes_it_known_right_before_the_camera() -> None:
    """Between where the aircraft stands and where its view is wide enough no gap is left (missions, seed 3015)."""
    space, here = Space(), np.array([3.0, -2.0])
    space.visit(here)
    _looked(space, [], (3.0, -2.0), -1.2)
    ahead = here + 0.9 * np.array([np.cos(-1.2), np.sin(-1.2)])
    assert space.known_ahead_m(here, ahead, 0.35) == pytest.approx(0.9)
    aside = here + 0.9 * np.array([np.cos(0.4), np.sin(0.4)])
    assert space.known_ahead_m(here, aside, 0.35) < 0.9
