"""Bounds are bounds: never above Coal's exact distance, for every kind of body, at rest and along motions."""

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from dyngrasp.models.bounding_volumes import bounding_bodies, bounding_capsule, boxes_around
from dyngrasp.models.distance_bounds import (
    GROUND,
    Candidates,
    add_near_each_other,
    add_near_ground,
    add_near_pieces,
    add_pieces_near_ground,
    lowest,
    space_for,
    tighten,
)
from dyngrasp.models.link_motion import Motion, paths_from_part, paths_in_world, to_middles

GJK = 1e-6  # m, tolerance of Coal's iterations


def convex(points: np.ndarray) -> coal.Convex:
    hull = trimesh.convex.convex_hull(points)
    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        vertices.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(vertices, faces)


CLOUD = np.random.default_rng(5).normal(size=(30, 3)) * [0.02, 0.05, 0.01]
SHAPES = {
    "capsule": coal.Capsule(0.03, 0.2),
    "cylinder": coal.Cylinder(0.05, 0.06),
    "sphere": coal.Sphere(0.04),
    "box": coal.Box(0.02, 0.14, 0.06),
    "ellipsoid": coal.Ellipsoid(0.02, 0.007, 0.011),
    "convex": convex(CLOUD),
}


def distance(a, T_a: pin.SE3, b, T_b: pin.SE3) -> float:
    at = [coal.Transform3s(T.rotation, T.translation) for T in (T_a, T_b)]
    return coal.distance(a, at[0], b, at[1], coal.DistanceRequest(), coal.DistanceResult())


def walk(random: np.random.Generator, samples: int, spread: float) -> list[pin.SE3]:
    """A smooth random motion."""
    T = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * spread)
    step = pin.Motion(random.normal(size=6) * 0.02)
    motion = [T]
    for _ in range(samples - 1):
        motion.append(motion[-1] * pin.exp6(step))
    return motion


def arrays(motion: list[pin.SE3]) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (3, 3, S) and positions (3, S)."""
    return np.stack([T.rotation for T in motion], axis=-1), np.stack([T.translation for T in motion], axis=-1)


@pytest.mark.parametrize("name", SHAPES)
def test_bounding_capsule_contains_the_body(name):
    ends, radius = bounding_capsule(SHAPES[name])
    for direction in np.random.default_rng(0).normal(size=(300, 3)):
        direction /= np.linalg.norm(direction)
        plane = coal.Halfspace(direction, 0.0)
        lowest = distance(SHAPES[name], pin.SE3.Identity(), plane, pin.SE3.Identity())
        bound = (ends @ direction).min() - radius
        assert bound <= lowest + 1e-12
        # A bound that is far off would contain it as well; the rounded ends cost one radius, a cloud a little more.
        assert lowest - bound < 1.5 * radius


def on_links(shapes, links, count):
    """Bodies at random places on some of the links, and these places."""
    random = np.random.default_rng(len(shapes))
    placements = [pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.05) for _ in shapes]
    return *bounding_bodies(shapes, placements, np.array(links), count), placements


def moving(motions, middles, reaches, q=None, levers=None, lifted=None) -> Motion:
    """Of links that move like this, the last one with the part; all joints of q (m, S) are the hand's."""
    R, p = (np.stack(column) for column in zip(*(arrays(motion) for motion in motions), strict=True))
    paths = np.empty((2, *p.shape[::2]))
    to_middles(R, p, np.vstack(middles))
    paths_in_world(R, p, np.array(reaches), paths[0])
    q = np.zeros((1, p.shape[2])) if q is None else q
    levers = np.full(len(motions), -1.0) if levers is None else levers
    paths_from_part(paths[0], q, np.arange(len(q)), levers, p.shape[2] if lifted is None else lifted, paths[1])
    return Motion(R, p, paths)


def added(add, *arguments):
    """What one of the functions adds to nothing, where there is room for all."""
    found = space_for(10000)
    count = add(*arguments, found, 0)
    return Candidates(found.which[:count], found.bounds[:count])


def still(samples):
    return [pin.SE3.Identity()] * samples


def check(found, exact, horizon, counted):
    """Bounds are below the exact distances {pair: (S,)}, and what is left out is farther, at the samples that count."""
    bounds = {pair: np.full(len(counted), np.inf) for pair in exact}
    for (i, j, k), bound in zip(found.which.tolist(), found.bounds, strict=True):
        assert np.isposinf(bounds[i, j][k])
        bounds[i, j][k] = bound
    if found.bounds.size:
        assert lowest(found.bounds, (0, found.bounds.size)) == found.bounds.argmin()
    for pair, distances in exact.items():
        known = bounds[pair] < np.inf
        assert not known[~counted].any()
        assert (bounds[pair][known] <= distances[known] + GJK).all()
        near = distances < horizon - GJK
        skipped = counted & ~known & near
        # What is left out between two samples was seen to stay where it is.
        assert not skipped.any(), pair
    return bounds


def check_neighbours(pair, distances, counted, one, other):
    """One measurement bounds all other samples of the pair, for the paths (S,) of two links, and nothing else."""
    i, j = pair
    samples = np.flatnonzero(counted)
    for at in (0, samples.size // 2):
        found = space_for(samples.size + 1)
        found.which[:-1], found.which[-1] = [(i, j, k) for k in samples], (i, j + 1, samples[0])
        found.bounds[:] = -np.inf
        least = tighten(found, (0, samples.size + 1), at, distances[samples[at]], one, other)
        assert np.isposinf(found.bounds[at])
        assert np.isneginf(found.bounds[-1])
        assert least == samples.size
        others = np.delete(np.arange(samples.size), at)
        assert (found.bounds[others] <= distances[samples[others]] + 2 * GJK).all()
        assert np.isfinite(found.bounds[others]).all()
        assert tighten(found, (0, samples.size), at, distances[samples[at]], one, other) == found.bounds[:-1].argmin()


def taken_and_carried(random, samples, lifted):
    """Motions of the world, a carrier, a link behind one joint on it, a part, and positions (1, S) of that joint.

    The part moves by itself first; from sample `lifted` on it is fixed to the carrier.
    """
    carrier, hinge = walk(random, samples, 0.12), pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.05)
    q = np.cumsum(random.uniform(0.0, 0.03, (1, samples)), axis=1)
    turned = (pin.SE3(pin.utils.rotate("z", angle), np.zeros(3)) for angle in q[0])
    behind = [T * hinge * turn for T, turn in zip(carrier, turned, strict=True)]
    hanging = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.05)
    return [still(samples), carrier, behind, [*walk(random, lifted, 0.02), *(T * hanging for T in carrier[lifted:])]], q


@pytest.mark.parametrize("seed", range(5))
def test_paths_bound_what_points_do(seed):
    """Points anywhere in what a link reaches: how far they move, how their distances from those of the part change."""
    random = np.random.default_rng(seed)
    samples, lifted = 40, 25
    motions, q = taken_and_carried(random, samples, lifted)
    middles, reaches = random.normal(size=(4, 3)) * 0.1, np.array([0.3, 0.2, 0.05, 0.1])
    levers = np.array([-1.0, 0.0, reaches[2] + np.linalg.norm(middles[2]), -1.0])
    in_world, from_part = moving(motions, middles, reaches, q, levers, lifted).paths

    def point_of(k):
        direction = random.normal(size=3)
        point = middles[k] + reaches[k] * direction / np.linalg.norm(direction)
        return np.array([T.act(point) for T in motions[k]])

    most = np.zeros(4)
    for k in range(4):
        for _ in range(200):
            points = point_of(k)
            moved = np.linalg.norm(points[:, None] - points, axis=2)
            assert (moved <= np.abs(in_world[k][:, None] - in_world[k]) + 1e-12).all()
            apart = np.linalg.norm(points - point_of(3), axis=1)
            changed, allowed = np.abs(apart[:, None] - apart), np.abs(from_part[k][:, None] - from_part[k])
            assert (changed <= allowed + 1e-12).all()
            most[k] = max(most[k], (changed[lifted:, lifted:] / np.maximum(allowed[lifted:, lifted:], 1e-12)).max())
    # From the lift on nothing but joints of the hand turns what is behind the carrier; for them it is not far off.
    assert np.ptp(from_part[1, lifted:]) == np.ptp(from_part[3]) == 0.0
    assert most[2] > 0.25


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("seed", range(6))
def test_bounds_to_pieces_and_their_neighbours(name, seed):
    """Against the exact distance to the box itself at every sample, also of those that were skipped.

    The part moves by itself first; then it is fixed to a carrier behind which one more joint turns the bodies.
    """
    random = np.random.default_rng(seed)
    samples, lifted, horizon = 90, 60, 0.15
    motions, q = taken_and_carried(random, samples, lifted)
    fingers, part = motions[2:]
    shapes = [SHAPES[name], SHAPES["sphere"]]
    bodies, middles, placements = on_links(shapes, [2, 2], 3)
    half = random.uniform(0.02, 0.08, (2, 3))
    centres = random.normal(size=(2, 3)) * 0.03
    pieces, middle = boxes_around([centres[i] + np.vstack([-half[i], half[i]]) for i in range(2)], 7)
    reaches = [*bodies.reaches, np.linalg.norm(pieces.around[1])]
    levers = np.array([-1.0, 0.0, bodies.reaches[2] + np.linalg.norm(middles[2]), -1.0])
    motion = moving(motions, [*middles, middle], reaches, q, levers, lifted)
    start, stop = 3, samples - 4
    windows = np.array([[start, stop], [samples, samples]])
    found = added(add_near_pieces, motion, bodies, pieces, windows, horizon)
    exact = {
        (0, 7 + i): np.array(
            [
                distance(
                    SHAPES[name], fingers[k] * placements[0],
                    coal.Box(*(2 * half[i])), part[k] * pin.SE3(np.eye(3), centres[i]),
                )
                for k in range(samples)
            ]
        )
        for i in range(2)
    }  # fmt: skip
    counted = (np.arange(samples) >= start) & (np.arange(samples) < stop)
    check(found, exact, horizon, counted)
    paths = motion.paths[1]
    assert (paths[-1] == 0.0).all()
    for pair, distances in exact.items():
        check_neighbours(pair, distances, counted, paths[2], paths[-1])


@pytest.mark.parametrize("seed", range(8))
def test_bounds_between_capsules_are_exact_where_they_are_apart(seed):
    random = np.random.default_rng(seed)
    samples, horizon = 50, 0.2
    motions = [still(samples), *(walk(random, samples, 0.15) for _ in range(3))]
    shapes, links = [SHAPES[name] for name in ("capsule", "sphere", "cylinder", "convex")], [1, 2, 3, 3]
    bodies, middles, placements = on_links(shapes, links, len(motions))
    placed = [[T * place for T in motions[link]] for link, place in zip(links, placements, strict=True)]
    motion = moving(motions, middles, bodies.reaches)
    found = added(add_near_each_other, motion, bodies, np.array([[1, 2], [1, 3], [2, 3]]), horizon)
    exact = {
        (i, j): np.array([distance(shapes[i], placed[i][k], shapes[j], placed[j][k]) for k in range(samples)])
        for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3))
    }
    everywhere = np.ones(samples, dtype=bool)
    bounds = check(found, exact, horizon, everywhere)
    known = (bounds[0, 1] < np.inf) & (exact[0, 1] > 0)
    np.testing.assert_allclose(bounds[0, 1][known], exact[0, 1][known], atol=GJK)
    for (i, j), distances in exact.items():
        check_neighbours((i, j), distances, everywhere, *motion.paths[0, [links[i], links[j]]])


def test_parallel_and_crossing_segments():
    """The cases in which the nearest points of two lines are not unique, or not on the segments."""
    across, behind, above = np.array([0.5, 0, 0]), np.array([3, 0, 0]), np.array([0, 0, 1.0])
    along, turned = pin.utils.rotate("y", np.pi / 2), pin.utils.rotate("x", np.pi / 2)
    thin, ball = 1e-9, coal.Sphere(1e-9)
    rod = coal.Capsule(thin, 1.0)
    others = [
        (rod, pin.SE3(along, across + [0, 0.3, 0]), 0.3),  # parallel, overlapping
        (rod, pin.SE3(along, behind + [0, 0.4, 0]), np.hypot(2, 0.4)),  # parallel, behind
        (rod, pin.SE3(turned, 0.2 * above), 0.2),  # crossing above
        (ball, pin.SE3(np.eye(3), np.array([1.5, 2, 0])), np.hypot(1, 2)),  # a point
    ]
    for shape, placement, expected in others:
        for pair in ((0, 1), (1, 0)):
            shapes, placements = [rod, shape], [pin.SE3(along, np.zeros(3)), placement]
            links = np.array([0, 1])
            bodies, middles = bounding_bodies([shapes[i] for i in pair], [placements[i] for i in pair], links, 2)
            motion = moving([still(1), still(1)], middles, bodies.reaches)
            found = added(add_near_each_other, motion, bodies, np.array([[0, 1]]), 10.0)
            np.testing.assert_allclose(found.bounds, expected, atol=3 * thin)


def test_heights_are_those_of_the_lowest_points():
    random = np.random.default_rng(1)
    samples, horizon = 30, 0.2
    motions = [still(samples), walk(random, samples, 0.3), walk(random, samples, 0.2)]
    shapes, everywhere = [SHAPES["capsule"], SHAPES["box"]], np.ones(samples, dtype=bool)
    bodies, middles, placements = on_links(shapes, [1, 1], 2)
    half = np.array([0.01, 0.07, 0.03])
    pieces, middle = boxes_around([np.vstack([-half, half])], 5)
    motion = moving(motions, [*middles, middle], [*bodies.reaches, np.linalg.norm(half)])
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    exact = {
        (i, GROUND): np.array(
            [distance(shapes[i], T * placements[i], ground, pin.SE3.Identity()) for T in motions[1]]
        )
        for i in range(2)
    }  # fmt: skip
    alone = added(add_near_ground, motion, bodies, horizon)
    bounds = check(alone, exact, horizon, everywhere)
    known = bounds[0, GROUND] < np.inf
    assert known.any()
    np.testing.assert_allclose(bounds[0, GROUND][known], exact[0, GROUND][known], atol=1e-12)
    check_neighbours((0, GROUND), exact[0, GROUND], everywhere, *motion.paths[0, [1, 0]])
    window = 4, samples - 2
    found = added(add_pieces_near_ground, motion, pieces, window, horizon)
    exact = {(5, GROUND): np.array([distance(SHAPES["box"], T, ground, pin.SE3.Identity()) for T in motions[-1]])}
    counted = (np.arange(samples) >= window[0]) & (np.arange(samples) < window[1])
    bounds = check(found, exact, horizon, counted)
    known = bounds[5, GROUND] < np.inf
    assert known.any()
    np.testing.assert_allclose(bounds[5, GROUND][known], exact[5, GROUND][known], atol=1e-12)
    check_neighbours((5, GROUND), exact[5, GROUND], counted, *motion.paths[0, [-1, 0]])
    # Without room for all there is no answer.
    assert add_near_ground(motion, bodies, horizon, space_for(len(alone.bounds) - 1), 0) == -1
    assert add_pieces_near_ground(motion, pieces, window, horizon, space_for(len(found.bounds) - 1), 0) == -1
    assert add_pieces_near_ground(motion, pieces, window, horizon, space_for(1000), -1) == -1
    # What is added later leaves what was there and comes after it.
    both = space_for(len(alone.bounds) + len(found.bounds))
    first = add_near_ground(motion, bodies, horizon, both, 0)
    assert add_pieces_near_ground(motion, pieces, window, horizon, both, first) == both.bounds.size
    for together, one, other in zip(both, alone, found, strict=True):
        np.testing.assert_array_equal(together, np.concatenate([one, other]))


def test_volumes_around_links_contain_their_bodies():
    shapes, links = list(SHAPES.values()), [1, 1, 1, 2, 2, 2]
    bodies, middles, placements = on_links(shapes, links, 3)
    for direction in np.random.default_rng(0).normal(size=(100, 3)):
        direction /= np.linalg.norm(direction)
        plane = coal.Halfspace(direction, 0.0)
        for b, (shape, T, k) in enumerate(zip(shapes, placements, links, strict=True)):
            low = distance(shape, T, plane, pin.SE3.Identity()) - middles[k] @ direction
            assert (bodies.link_ends[k] @ direction).min() - bodies.link_radii[k] <= low + 1e-12
            assert -bodies.reaches[k] <= low + 1e-12
            assert (bodies.ends[b] @ direction).min() - bodies.radii[b] <= low + 1e-12
            rounded = bodies.ends[b].mean(axis=0) @ direction - np.abs(bodies.halves[b] @ direction).sum()
            assert rounded - bodies.rounding[b] <= low + 1e-12
