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
from dyngrasp.models.distance_bounds import add_near_ground, add_near_pieces, space_for
from dyngrasp.planning import clearance
from dyngrasp.planning.cell_geometry import cell_geometry, motion_along
from dyngrasp.planning.clearance import HORIZON, RESOLUTION, clearance_entries
from dyngrasp.planning.part_motion import part_motion
from dyngrasp.planning.plan_samples import JOINT_STEP, waypoints
from dyngrasp.trajectory import PHASE_NAMES


def sampled(task, plan, since=-np.inf):
    """Times, configurations (n + m, S) and the first samples of grasp and delivery."""
    assembly = assemble(task.robot, task.gripper)
    arm, gripper, ends = plan.arrays
    return waypoints(arm, gripper, ends, since, (assembly.arm_indices, assembly.hand_indices))


def straightforward(task, targets, plan, since):
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

    def note(name, a, at_a, b, at_b):
        worst[name] = min(worst[name], coal.distance(a, at_a, b, at_b, coal.DistanceRequest(), coal.DistanceResult()))

    def pose(T):
        return coal.Transform3s(T.rotation, T.translation)

    times, q, closing, lifted = sampled(task, plan, since)
    for k, t in enumerate(times):
        phase = "approach" if k < closing else "grasp" if k < lifted else "deliver"
        pin.updateGeometryPlacements(model, data, geometry, placed, np.ascontiguousarray(q[:, k]))
        T_part = targets.T_world_object_at(t)
        if phase == "deliver":
            T_part = pin.updateFramePlacement(model, data, assembly.flange_id) * T_flange_object
        part, world, at = pose(T_part), pose(pin.SE3.Identity()), [pose(T) for T in placed.oMg]
        for i, body in enumerate(bodies):
            on_hand = body.name in hand
            if on_hand or body.parentJoint > 0:
                note("ground_clearance", body.geometry, at[i], ground, world)
                if phase == "approach" or body.name not in pads:
                    for piece in pieces:
                        note("part_clearance", body.geometry, at[i], piece, part)
            if phase == "deliver" and not on_hand:
                for piece in pieces:
                    note("carried_clearance", piece, part, body.geometry, at[i])
        for (i, a), (j, b) in itertools.product(enumerate(bodies), enumerate(bodies)):
            links = [n if body.name in hand else min(body.parentJoint, n) for body in (a, b)]
            if links[1] - links[0] >= 3:
                note("self_clearance", a.geometry, at[i], b.geometry, at[j])
        if phase == "deliver":
            for piece in pieces:
                note("carried_clearance", piece, part, ground, world)
    return worst


def convex(path) -> coal.Convex:
    hull = trimesh.load_mesh(path).convex_hull
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        points.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(points, faces)


def at_once(cell, q, task, targets, lifted=1):
    """Poses of all links (F, 3, 3, 1), (F, 3, 1) with the arm at q and the hand open, the part standing or hanging."""
    posture = np.ascontiguousarray(cell.assembly.configuration(q, task.gripper.open_posture)[:, None])
    return motion_along(posture, np.zeros(1), lifted, part_motion(targets), cell.kinematics)[0][:2]


def shifted(plan, aside):
    """The plan with joints of the arm, by index, elsewhere all the time."""
    offset = np.zeros(len(plan.arm_joints))
    offset[list(aside)] = list(aside.values())
    return replace(plan, arm=tuple(replace(phase, position=phase.position + offset) for phase in plan.arm))


def moved(targets, translation):
    T = targets.T_world_object.copy()
    T.translation = T.translation + translation
    return replace(targets, T_world_object=T)


@pytest.mark.parametrize(
    ("aside", "since"),
    [
        ({}, 2.9),  # the plan as it is
        ({0: 0.03}, 3.3),  # fingers against the rib
        ({1: 0.15}, 3.4),  # the hand in the part and in the ground
        ({3: -0.9, 1: -0.2}, 3.8),  # folded towards itself
        ({3: -1.4, 5: 0.3}, 4.5),  # the hand in the base
        ({}, 3.5),  # from the grasp on
        ({1: 0.1}, 5.0),  # part and hand in the ground when most is over
    ],
    ids=["as planned", "aside", "too low", "folded", "into itself", "in the grasp", "in the delivery"],
)
def test_the_same_as_measuring_everything(task, targets, plan, aside, since):
    assert_same(task, targets, shifted(plan, aside), since)


@pytest.mark.parametrize(
    ("translation", "velocity", "since"),
    [
        ([0.01, -0.015, 0.0], np.zeros(6), 3.5),  # it hangs elsewhere than it stands
        ([0.0, 0.0, -0.004], np.zeros(6), 3.8),  # sunk into the ground
        ([-0.15, 0.1, 0.2], np.zeros(6), 2.9),  # in the way
        ([0.0, 0.0, 0.0], np.array([0.1, -0.05, 0.0, 0.0, 0.0, 0.4]), 2.9),  # on a turning belt
        ([0.0, 0.0, 0.0], np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0]), 3.5),  # falling through the hand
    ],
    ids=["displaced", "sunk", "in the way", "riding", "falling"],
)
def test_the_same_for_parts_that_are_elsewhere(task, targets, plan, translation, velocity, since):
    elsewhere = replace(moved(targets, translation), grasp_time=float(plan.phase_ends[1]), twist_world=velocity)
    assert_same(task, elsewhere, plan, since)


def assert_same(task, targets, plan, since):
    expected = straightforward(task, targets, plan, since)
    found = {entry.name: entry for entry in clearance_entries(task, targets, plan, since)}
    assert set(found) == set(expected)
    for name, distance in expected.items():
        # Both stop within Coal's tolerance; how deep bodies are in each other, its expanding polytope finds less well.
        tolerance = 2 * RESOLUTION if distance > 0 else 2 * RESOLUTION + 1e-4
        assert found[name].worst == pytest.approx(distance, abs=tolerance), name


def test_more_candidates_than_there_was_room_for_at_first(task, targets, plan):
    """The hand in the part and in the ground: more candidates than most plans have, and none of them lost."""
    cell = cell_geometry(task, targets.grasp.name)
    times, q, closing, lifted = sampled(task, shifted(plan, {1: 0.15}))
    motion, _ = motion_along(q, times, lifted, part_motion(targets), cell.kinematics)
    bodies, pieces = cell.bodies, cell.pieces
    found, groups = clearance._anywhere(
        tuple(motion), closing, lifted, HORIZON, HORIZON, cell.volumes, cell.link_pairs, cell.is_pad, cell.on_arm
    )
    assert len(found[1]) == groups[-1] > 8 * clearance._FEW
    most = space_for(bodies.radii.size * (bodies.radii.size + 2 * len(pieces.low.T)) * times.size)
    windows = clearance._until_closing(bodies, cell.is_pad, closing, 0, times.size)
    count = add_near_pieces(motion, bodies, pieces, windows, HORIZON, most, 0)
    assert groups[1] == count > clearance._FEW
    count = add_near_ground(motion, bodies, HORIZON, most, count)
    assert groups[2] == count > groups[1]
    for one, other in zip(found, most, strict=True):
        np.testing.assert_array_equal(one[:count], other[:count])


def test_levers_of_the_hand(task, targets):
    """Joints of the hand, one after the other and all at once: how far bodies move as seen from what carries them."""
    cell = cell_geometry(task, targets.grasp.name)
    _, hand, (carrier, _, _), _, reaches, levers = cell.kinematics
    on_hand = np.flatnonzero(levers >= 0.0)
    # All links of the hand are behind the last one of the arm, which no joint of the hand turns.
    assert on_hand.tolist() == [carrier, *(hand + 1).tolist()]
    assert levers[carrier] == 0.0
    random = np.random.default_rng(2)
    for moving in [*np.eye(hand.size), *random.uniform(-1, 1, (4, hand.size))]:
        q = np.zeros((task.robot.n + hand.size, 30))
        q[:] = random.uniform(-1, 1, (len(q), 1))
        q[hand] += moving[:, None] * np.linspace(0.0, 1.5, 30)
        motion, _ = motion_along(q, np.arange(30.0), 0, part_motion(targets), cell.kinematics)
        path = motion.paths[1]
        for k in on_hand:
            R, p = np.moveaxis(motion.R, -1, 0), np.moveaxis(motion.p, -1, 0)
            for direction in random.normal(size=(20, 3)):
                point = R[:, k] @ (direction / np.linalg.norm(direction) * reaches[k]) + p[:, k] - p[:, carrier]
                seen = np.einsum("sba,sb->sa", R[:, carrier], point)
                steps = np.linalg.norm(seen[:, None] - seen, axis=2)
                assert (steps <= np.abs(path[k][:, None] - path[k]) + 1e-12).all()


def test_entry_says_where_and_who(task, targets, plan):
    """What an entry names really is that far apart at that time."""
    cell, near = cell_geometry(task, targets.grasp.name), 0
    for other_plan in (plan, shifted(plan, {0: 0.03}), shifted(plan, {3: -1.4, 5: 0.3})):
        times, q, _, lifted = sampled(task, other_plan)
        motion, _ = motion_along(q, times, lifted, part_motion(targets), cell.kinematics)
        for entry in clearance_entries(task, targets, other_plan):
            if entry.worst == HORIZON:
                assert entry.detail == ""
                continue
            near += 1
            i, j = (cell.names.index(name) for name in entry.detail.split(" and "))
            at = [cell.distance(i, j, motion.R, motion.p, k) for k in np.flatnonzero(times == entry.time).tolist()]
            assert np.abs(np.array(at) - entry.worst).min() == 0.0
    assert near >= 6


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
        poses = at_once(cell, q, task, targets)
        for i, j in itertools.combinations(arm, 2):
            expected = mujoco.mj_geomDistance(model, data, names[cell.names[i]], names[cell.names[j]], 2.0, None)
            if expected > 0:
                apart += 1
                # MuJoCo's own iterations stop at 1e-6.
                assert cell.distance(i, j, *poses, 0) == pytest.approx(expected, abs=5e-6), (
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
        R, p = at_once(cell, task.place, task, replace(targets, T_world_object=T))
        for i, path in enumerate(task.grasp_object.piece_paths):
            vertices = np.asarray(trimesh.load_mesh(path).vertices)
            expected = (vertices @ T.rotation.T + T.translation)[:, 2].min()
            found = cell.distance(cell.first_piece + i, cell.ground, R, p, 0)
            assert found == pytest.approx(expected, abs=1e-7)


def test_a_moving_part_is_met_where_it_is(task, targets, plan):
    """A part that falls through the hand on its way to where it is taken."""
    falling = np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0])
    moving = replace(targets, grasp_time=float(plan.phase_ends[1]), twist_world=falling)
    at_rest = {entry.name: entry for entry in clearance_entries(task, targets, plan)}
    from_above = {entry.name: entry for entry in clearance_entries(task, moving, plan)}
    assert at_rest["part_clearance"].ok
    # 0.5 s before the grasp the part would be 25 cm higher, inside the hand.
    assert not from_above["part_clearance"].ok
    assert from_above["ground_clearance"] == at_rest["ground_clearance"]


@pytest.mark.parametrize("phase", range(3), ids=PHASE_NAMES)
def test_not_a_number_never_passes(task, targets, plan, phase):
    arm, gripper, ends = plan.arrays
    position = arm[phase][1].copy()
    position[3, 2] = np.nan
    position.setflags(write=False)
    broken = replace(plan)
    # Trajectories refuse it; what calls itself a plan need not be made of them.
    nowhere = (*arm[:phase], (arm[phase][0], position, *arm[phase][2:]), *arm[phase + 1 :])
    object.__setattr__(broken, "arrays", (nowhere, gripper, ends))
    for entries in (
        clearance_entries(task, targets, broken),
        clearance_entries(task, moved(targets, [np.nan, 0.0, 0.0]), plan),
    ):
        assert len(entries) == 4
        assert not any(entry.ok for entry in entries)
        assert {entry.detail for entry in entries} == {"a motion that is not finite"}


@pytest.mark.parametrize("since", [-np.inf, 0.37, 3.5, 6.0])
def test_samples_are_no_farther_apart_than_stated(task, plan, since):
    times, q, closing, lifted = sampled(task, plan, since)
    ends = [max(since, plan.start_time), *(t for t in plan.phase_ends if t > since)]
    phases = [0, closing, lifted, times.size]
    kept = 0
    for start, stop, T in zip(phases[:-1], phases[1:], plan.phase_ends, strict=True):
        assert (stop == start) == (since >= T)
        if stop > start:
            assert times[[start, stop - 1]] == pytest.approx(ends[kept : kept + 2], abs=1e-12)
            kept += 1
            # The path within an interval is taken as straight: joints that turn at different rates bend it a little.
            assert np.abs(np.diff(q[:, start:stop], axis=1)).max() <= 1.02 * JOINT_STEP
    assembly = assemble(task.robot, task.gripper)
    for k, t in enumerate(times):
        sample = plan.sample(t)
        expected = assembly.configuration(sample.arm.position, sample.gripper.position)
        np.testing.assert_allclose(q[:, k], expected, atol=1e-9)
