"""Clearances against measuring every pair at every sample, and against MuJoCo as a second opinion."""

import itertools
from dataclasses import replace

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from dyngrasp.models.assembly import assemble
from dyngrasp.models.distance_bounds import add_near_pieces, first_of, space_for
from dyngrasp.planning import clearance
from dyngrasp.planning.cell_geometry import cell_geometry
from dyngrasp.planning.clearance import HORIZON, RESOLUTION, clearance_entries
from dyngrasp.planning.part_motion import part_motion
from dyngrasp.planning.plan_samples import JOINT_STEP, Waypoints, waypoints_of
from dyngrasp.trajectory import PHASE_NAMES


def straightforward(task, targets, waypoints):
    """Every pair of bodies at every sample, one after the other: slow, and nothing to go wrong in it."""
    assembly = assemble(task.robot, task.gripper)
    model, geometry = assembly.pin_model, assembly.geometry
    data, placed = model.createData(), pin.GeometryData(geometry)
    bodies, n = list(geometry.geometryObjects), task.robot.n
    hand, pads = set(assembly.hand_geoms), set(assembly.pad_geoms)
    pieces = [convex(path) for path in task.grasp_object.piece_paths]
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    closed = task.gripper.posture_for(targets.grasp.width - task.settings.over_close)
    T_flange_grasp = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(closed)
    T_flange_object = T_flange_grasp * targets.grasp.T_object_grasp.inverse()
    worst = dict.fromkeys(("ground_clearance", "part_clearance", "self_clearance", "carried_clearance"), HORIZON)

    def note(name, a, T_a, b, T_b):
        at = [coal.Transform3s(T.rotation, T.translation) for T in (T_a, T_b)]
        distance = coal.distance(a, at[0], b, at[1], coal.DistanceRequest(), coal.DistanceResult())
        worst[name] = min(worst[name], distance)

    for k in range(waypoints.times.size):
        phase = "approach" if k < waypoints.closing else "grasp" if k < waypoints.lifted else "deliver"
        q, q_h = waypoints.q[:, k], waypoints.q_h[:, k]
        pin.updateGeometryPlacements(model, data, geometry, placed, assembly.configuration(q, q_h))
        T_part = targets.T_world_object
        if phase == "deliver":
            T_part = pin.updateFramePlacement(model, data, assembly.flange_id) * T_flange_object
        for i, body in enumerate(bodies):
            on_hand = body.name in hand
            if on_hand or body.parentJoint > 0:
                note("ground_clearance", body.geometry, placed.oMg[i], ground, pin.SE3.Identity())
                if phase == "approach" or body.name not in pads:
                    for piece in pieces:
                        note("part_clearance", body.geometry, placed.oMg[i], piece, T_part)
            if phase == "deliver" and not on_hand:
                for piece in pieces:
                    note("carried_clearance", piece, T_part, body.geometry, placed.oMg[i])
        for (i, a), (j, b) in itertools.product(enumerate(bodies), enumerate(bodies)):
            links = [n if body.name in hand else min(body.parentJoint, n) for body in (a, b)]
            if links[1] - links[0] >= 3:
                note("self_clearance", a.geometry, placed.oMg[i], b.geometry, placed.oMg[j])
        if phase == "deliver":
            for piece in pieces:
                note("carried_clearance", piece, T_part, ground, pin.SE3.Identity())
    return worst


def convex(path) -> coal.Convex:
    hull = trimesh.load_mesh(path).convex_hull
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        points.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(points, faces)


def at_once(q, task):
    """One sample of the arm at q with the open hand, the part standing."""
    return Waypoints(np.zeros(1), q[:, None], task.gripper.open_posture[:, None], 1, 1)


def with_times(waypoints, keep):
    """Some of the samples, by index."""
    closing, lifted = (int((np.asarray(keep) < k).sum()) for k in (waypoints.closing, waypoints.lifted))
    return Waypoints(waypoints.times[keep], waypoints.q[:, keep], waypoints.q_h[:, keep], closing, lifted)


@pytest.mark.parametrize(
    "aside",
    [
        {},  # the plan as it is
        {0: 0.03},  # fingers against the rib
        {1: 0.15},  # the hand in the part and in the ground
        {3: -0.9, 1: -0.2},  # folded towards itself
        {3: -1.4, 5: 0.3},  # the hand in the base
    ],
    ids=["as planned", "aside", "too low", "folded", "into itself"],
)
def test_the_same_as_measuring_everything(task, targets, plan, aside):
    offset = np.zeros(task.robot.n)
    offset[list(aside)] = list(aside.values())
    all_of_them = waypoints_of(plan)
    waypoints = with_times(all_of_them, np.arange(0, all_of_them.times.size, 3))
    waypoints = replace(waypoints, q=waypoints.q + offset[:, None])
    expected = straightforward(task, targets, waypoints)
    found = {entry.name: entry for entry in clearance_entries(task, targets, waypoints)}
    assert set(found) == set(expected)
    for name, distance in expected.items():
        # Both stop within Coal's tolerance; how deep bodies are in each other, its expanding polytope finds less well.
        tolerance = 2 * RESOLUTION if distance > 0 else 2 * RESOLUTION + 1e-4
        assert found[name].worst == pytest.approx(distance, abs=tolerance), name


def test_more_pairs_than_there_was_room_for_at_first(task, targets, plan):
    """The hand in the part and in the ground: more candidates than most plans have, and none of them lost."""
    waypoints = waypoints_of(plan)
    low = replace(waypoints, q=waypoints.q + np.eye(task.robot.n)[:, [1]] * 0.15)
    cell = cell_geometry(task, targets.grasp.name)
    found, expected = {}, {}
    for name, samples in (("usual", waypoints), ("low", low)):
        _, seen, _ = cell.motions(samples, part_motion(targets))
        every = np.tile([0, samples.times.size], (cell.bodies.radii.size, 1))
        pairs, _ = clearance._candidates_at_part(seen, cell.bodies, cell.pieces, every, HORIZON)
        pairs_at_most = cell.bodies.radii.size * cell.pieces.reaches.size
        most = space_for(pairs_at_most, pairs_at_most * samples.times.size)
        count = add_near_pieces(seen, cell.bodies, cell.pieces, every, HORIZON, most, 0)
        found[name], expected[name] = pairs, first_of(most, count)
    assert len(found["low"].pairs) > clearance._FEW
    for name in found:
        for one, other in zip(found[name], expected[name], strict=True):
            np.testing.assert_array_equal(one, other)


def test_entry_says_where_and_who(task, targets, plan):
    """What an entry names really is that far apart at that time."""
    waypoints = waypoints_of(plan)
    cell = cell_geometry(task, targets.grasp.name)
    for entry in clearance_entries(task, targets, waypoints):
        if entry.worst == HORIZON:
            assert entry.detail == ""
            continue
        one, other = entry.detail.split(" and ")
        at = []
        for k in np.flatnonzero(np.abs(waypoints.times - entry.time) < 1e-12):
            # The part, at a join, still stands or already hangs.
            for lifted in (0, 1):
                single = Waypoints(waypoints.times[[k]], waypoints.q[:, [k]], waypoints.q_h[:, [k]], 0, lifted)
                world, _, _ = cell.motions(single, part_motion(targets))
                at.append(cell.distance(cell.names.index(one), cell.names.index(other), world.R, world.p, 0))
        assert np.abs(np.array(at) - entry.worst).min() < 2 * RESOLUTION


def test_distances_are_mujocos(task, targets):
    """mj_geomDistance of the same description, for random postures; cutoff and tolerance as documented there."""
    spec = mujoco.MjSpec.from_file(str(task.robot.mjcf_path))
    model = spec.compile()
    data = mujoco.MjData(model)
    cell = cell_geometry(task, targets.grasp.name)
    names = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i): i for i in range(model.ngeom)}
    arm = [i for i, name in enumerate(cell.names) if name in names]
    assert len(arm) >= 2 * task.robot.n
    limits, random = task.robot.limits, np.random.default_rng(0)
    apart = 0
    for _ in range(12):
        q = random.uniform(limits.position_lower, limits.position_upper)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        world, _, _ = cell.motions(at_once(q, task), part_motion(targets))
        for i, j in itertools.combinations(arm, 2):
            expected = mujoco.mj_geomDistance(model, data, names[cell.names[i]], names[cell.names[j]], 2.0, None)
            if expected > 0:
                apart += 1
                # MuJoCo's own iterations stop at 1e-6.
                assert cell.distance(i, j, world.R, world.p, 0) == pytest.approx(expected, abs=5e-6), (
                    cell.names[i],
                    cell.names[j],
                )
    assert apart > 500


def test_pieces_and_ground_where_the_answer_is_known(task, targets):
    """The lowest vertex of each piece over the ground, for tilted parts."""
    cell = cell_geometry(task, targets.grasp.name)
    random = np.random.default_rng(1)
    for _ in range(5):
        T = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.2)
        world, _, _ = cell.motions(at_once(task.place, task), part_motion(replace(targets, T_world_object=T)))
        for i, path in enumerate(task.grasp_object.piece_paths):
            vertices = np.asarray(trimesh.load_mesh(path).vertices)
            expected = (vertices @ T.rotation.T + T.translation)[:, 2].min()
            found = cell.distance(cell.first_piece + i, cell.ground, world.R, world.p, 0)
            assert found == pytest.approx(expected, abs=1e-7)


def test_a_moving_part_is_met_where_it_is(task, targets, plan):
    """A part that falls through the hand on its way to where it is taken."""
    waypoints = waypoints_of(plan)
    falling = np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0])
    moving = replace(targets, grasp_time=float(plan.phase_ends[1]), twist_world=falling)
    at_rest = {entry.name: entry for entry in clearance_entries(task, targets, waypoints)}
    from_above = {entry.name: entry for entry in clearance_entries(task, moving, waypoints)}
    assert at_rest["part_clearance"].ok
    # 0.5 s before the grasp the part would be 25 cm higher, inside the hand.
    assert not from_above["part_clearance"].ok
    assert from_above["ground_clearance"] == at_rest["ground_clearance"]


@pytest.mark.parametrize("phase", range(3), ids=PHASE_NAMES)
def test_not_a_number_never_passes(task, targets, plan, phase):
    waypoints = waypoints_of(plan)
    q = waypoints.q.copy()
    q[2, (0, waypoints.closing, waypoints.lifted)[phase] + 3] = np.nan
    assert not any(entry.ok for entry in clearance_entries(task, targets, replace(waypoints, q=q)))
    nowhere = targets.T_world_object.copy()
    nowhere.translation = np.array([np.nan, 0.0, 0.0])
    assert not any(entry.ok for entry in clearance_entries(task, replace(targets, T_world_object=nowhere), waypoints))


@pytest.mark.parametrize("since", [-np.inf, 0.37, 3.5, 6.0])
def test_samples_are_no_farther_apart_than_stated(plan, since):
    waypoints = waypoints_of(plan, since)
    both = np.vstack([waypoints.q, waypoints.q_h])
    ends = [max(since, plan.start_time), *(t for t in plan.phase_ends if t > since)]
    phases = [0, waypoints.closing, waypoints.lifted, waypoints.times.size]
    kept = 0
    for start, stop, T in zip(phases[:-1], phases[1:], plan.phase_ends, strict=True):
        assert (stop == start) == (since >= T)
        if stop > start:
            assert waypoints.times[[start, stop - 1]] == pytest.approx(ends[kept : kept + 2], abs=1e-12)
            kept += 1
            # The path within an interval is taken as straight: joints that turn at different rates bend it a little.
            assert np.abs(np.diff(both[:, start:stop], axis=1)).max() <= 1.02 * JOINT_STEP
    for k, t in enumerate(waypoints.times):
        sample = plan.sample(t)
        np.testing.assert_allclose(both[:, k], [*sample.arm.position, *sample.gripper.position], atol=1e-9)
