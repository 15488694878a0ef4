"""Build the casting: visual mesh, convex contact pieces and ``model.toml``.

The part is drawn here as a union of convex cast bodies (draft, rounded corners and edges), less sand cores, bores and
bolt holes. Because every body is convex before it is hollowed, the same bodies are the contact pieces; no approximate
decomposition is involved, and the faces that the fingers pinch are exact in both.

The wall thickness is free and solved for, so that the mass comes out as ``MASS`` says.

Run from anywhere: ``python scripts/make_casting.py``; needs trimesh, manifold3d and scipy. Everything is deterministic:
running it again reproduces the committed files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import CrossSection, FillRule, JoinType, Manifold
from scipy.optimize import brentq

OUTPUT = Path(__file__).resolve().parents[1] / "src/dyngrasp/models/assets/objects/casting"

# Drawing frame: millimetres, x along the rib, y across it, z up, ground at z = 0, pinch centre above the origin.
DENSITY = 2700.0  # kg/m^3, aluminium casting alloy
GRASP_HEIGHT = 76.0
REST_HEIGHT = 100.0
RIB_HALF_THICKNESS = 17.0
RIB_TOP = 90.0
DECK = 35.0
PAD_RISE = 1.5
TOWER_TOP = 62.0
PORT_PLATE = 8.0
MASS = 0.750  # kg

Point = tuple[float, float]
Point3 = tuple[float, float, float]


@dataclass
class Drawing:
    """Collects bodies, cores (what is cut out) and the convex contact pieces."""

    bodies: list[Manifold] = field(default_factory=list)
    cores: list[Manifold] = field(default_factory=list)
    pieces: list[Manifold] = field(default_factory=list)

    def add(self, body: Manifold, *, contact: bool = True) -> None:
        """Add a body; only the concave foundry fillets are no contact pieces."""
        self.bodies.append(body)
        if contact:
            self.pieces.append(body)

    def cut(self, core: Manifold) -> None:
        self.cores.append(core)

    def solid(self) -> Manifold:
        """Bodies less cores, without edges so short that single precision would merge their ends."""
        return (_union(self.bodies) - _union(self.cores)).simplify(0.002)


def _union(parts: list[Manifold]) -> Manifold:
    total = Manifold()
    for part in parts:
        total = total + part
    return total


def area(polygon: list[Point]) -> CrossSection:
    """The area inside a polygon, whichever way round it is given."""
    return CrossSection([np.array(polygon, dtype=float)], FillRule.NonZero)


def _outline(polygon: list[Point], radius: float) -> CrossSection:
    """A convex polygon with its corners rounded."""
    raw = area(polygon)
    return raw.offset(-radius, JoinType.Miter).offset(radius, JoinType.Round, 2.0, 24)


def _loft(layers: list[tuple[CrossSection, float]]) -> Manifold:
    points = [(float(x), float(y), z) for section, z in layers for contour in section.to_polygons() for x, y in contour]
    return Manifold.hull_points(np.array(points))


def block(
    outline: CrossSection, bottom: float, top: float, draft: float = 0.0, edge: float = 0.0, edge_steps: int = 3
) -> Manifold:
    """A convex prism, drawn in by ``draft`` (mm) at the top, the top edge rounded with radius ``edge``."""
    layers = [(outline, bottom)]
    for step in range(edge_steps + 1 if edge else 1):
        angle = 0.5 * math.pi * step / edge_steps
        inset = draft + edge * (1.0 - math.cos(angle))
        layers.append((outline.offset(-inset, JoinType.Round, 2.0, 24), top - edge + edge * math.sin(angle)))
    return _loft(layers)


def discs(*circles: tuple[float, float, float]) -> CrossSection:
    """The convex outline around circles (x, y, radius)."""
    return CrossSection.batch_hull([CrossSection.circle(r, 28).translate((x, y)) for x, y, r in circles])


def cylinder(x: float, y: float, radius: float, bottom: float, top: float, segments: int = 32) -> Manifold:
    return Manifold.cylinder(top - bottom, radius, radius, segments).translate((x, y, bottom))


def cylinder_y(x: float, z: float, radius: float, start: float, end: float, segments: int = 32) -> Manifold:
    upright = Manifold.cylinder(end - start, radius, radius, segments)
    return upright.rotate((-90.0, 0.0, 0.0)).translate((x, start, z))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Manifold:
    return Manifold.cube(np.subtract(high, low)).translate(low)


def root_fillet(x: float, y: float, radius: float, foot: float, fillet: float) -> Manifold:
    """The concave ring between an upright cylinder and the plane z = foot."""
    arc = [
        (radius + fillet - fillet * math.cos(a), foot + fillet - fillet * math.sin(a))
        for a in np.linspace(0.0, 0.5 * math.pi, 5)
    ]
    profile = [(radius - 1.0, foot - 1.0), (radius + fillet, foot - 1.0), *reversed(arc), (radius - 1.0, foot + fillet)]
    return area(profile).revolve(32).translate((x, y, 0.0))


def web(start: Point, end: Point, thickness: float, profile: list[Point]) -> Manifold:
    """An upright stiffening web; ``profile`` gives (fraction along start-end, z)."""
    length = math.dist(start, end)
    heading = math.degrees(math.atan2(end[1] - start[1], end[0] - start[0]))
    flat = area([(s * length, z) for s, z in profile])
    plate = flat.extrude(thickness).translate((0.0, 0.0, -0.5 * thickness)).rotate((90.0, 0.0, 0.0))
    return plate.rotate((0.0, 0.0, heading)).translate((start[0], start[1], 0.0))


# --- the bodies -------------------------------------------------------------------------------------------------------

DECKS: tuple[list[Point], ...] = (
    [(-51, -19), (3, -21), (1, 63), (-47, 65)],
    [(-3, -64), (49, -66), (51, 22), (-3, 19)],
)
HOUSING = (-80.0, 9.0)
HOUSING_RADIUS = 26.0
TOWER_CENTRE = (77.0, -7.0)
PORT_X, PORT_Z = 29.0, 19.0
EARS = [(-58.0, 70.0), (-56.0, -50.0), (59.0, -72.0), (104.0, 28.0), (62.0, 58.0)]


def draw_rib(drawing: Drawing) -> None:
    """The machined web: exactly 34 mm over parallel faces, its ends sloped unlike, chamfered for lead-in."""
    half, chamfer = RIB_HALF_THICKNESS, 1.5
    side = area([(-31, 20), (32, 20), (30, 42), (27, RIB_TOP), (-27.5, RIB_TOP), (-27.5, 50)])
    full = side.offset(-7.0, JoinType.Miter).offset(7.0, JoinType.Round, 2.0, 32)
    # Only the top is rounded; the foot stands in the deck.
    inner = full.offset(-chamfer, JoinType.Miter)
    points = []
    for section, y in ((inner, -half), (full, -half + chamfer), (full, half - chamfer), (inner, half)):
        for contour in section.to_polygons():
            for x, z in contour:
                points.append((float(x), y, float(z)))
    drawing.add(Manifold.hull_points(np.array(points)))
    # The sand core leaves walls of 5 mm behind the pinched faces: stiff against 20 N, and half the weight.
    core = _outline([(-22.5, -12), (22, -12), (22, 12), (-22.5, 12)], 4.0)
    drawing.cut(block(core, -1.0, RIB_TOP - 7.0, draft=0.5, edge=3.0))
    # Foundry fillets along both faces end below the zone that the fingers use.
    radius, foot = 5.0, DECK
    # Each stands on the flat top of one deck: on the other side of the rib the decks end at its face.
    flats = _union([_outline(polygon, 7.0).offset(-5.0, JoinType.Round, 2.0, 16).extrude(60.0) for polygon in DECKS])
    for sign in (-1.0, 1.0):
        arc = [
            (sign * (half + radius - radius * math.cos(a)), foot + radius - radius * math.sin(a))
            for a in np.linspace(0.0, 0.5 * math.pi, 6)
        ]
        profile = [*arc, (sign * (half + radius), foot - 1.0), (sign * (half - 1.0), foot - 1.0)]
        profile.append((sign * (half - 1.0), foot + radius))
        strip = area(profile).extrude(58.0).rotate((90.0, 0.0, 90.0)).translate((-29.0, 0.0, 0.0))
        drawing.add(strip ^ flats, contact=False)


def draw_decks(drawing: Drawing, wall: float) -> None:
    """Two hollow decks beside the rib, set off from each other, each with a machined marker pad."""
    for polygon in DECKS:
        outline = _outline(polygon, 7.0)
        drawing.add(block(outline, 0.0, DECK, draft=2.0, edge=3.0))
        drawing.cut(block(outline.offset(-wall, JoinType.Round, 2.0, 16), -1.0, DECK - wall, draft=2.0))
    for x, y in ((-25.0, 42.0), (25.5, -43.0)):
        pad = _outline([(x - 20, y - 20), (x + 20, y - 20), (x + 20, y + 20), (x - 20, y + 20)], 3.0)
        drawing.add(block(pad, DECK - 6.0, DECK + PAD_RISE))
    # The low step in the corner that the decks leave free, with two screw bosses.
    step = _outline([(-48, -44), (-1, -36), (-1, -10), (-50, -10)], 6.0)
    drawing.add(block(step, 0.0, 20.0, draft=1.5, edge=3.0))
    drawing.cut(block(step.offset(-wall, JoinType.Round, 2.0, 16), -1.0, 20.0 - wall))
    for x, y, top in ((-38.0, -31.0, 28.0), (-16.0, -27.0, 28.0)):
        drawing.add(block(discs((x, y, 7.5)), 4.0, top, draft=0.7, edge=1.0, edge_steps=2))
        # Where the flat top of the step ends, its fillet ends too.
        flat = step.offset(-4.5, JoinType.Round, 2.0, 16).extrude(40.0)
        drawing.add(root_fillet(x, y, 7.2, 20.0, 3.0) ^ flat, contact=False)
        drawing.cut(cylinder(x, y, 2.6, 8.0, top + 1.0, 16))


def draw_housing(drawing: Drawing, wall: float) -> None:
    """The bearing housing: bored through, four tapped holes in its face, a marker pad on the far side."""
    x, y = HOUSING
    drawing.add(block(discs((x, y, HOUSING_RADIUS)), 0.0, 60.0, draft=0.8, edge=1.0, edge_steps=2))
    drawing.add(block(discs((x, y, HOUSING_RADIUS + 1.5)), 54.0, 64.0, edge=1.5), contact=True)
    drawing.add(root_fillet(x, y, HOUSING_RADIUS, 5.0, 3.5), contact=False)
    drawing.cut(cylinder(x, y, HOUSING_RADIUS - 1.2 * wall - 0.8, -1.0, 58.0, 40))
    drawing.cut(cylinder(x, y, HOUSING_RADIUS - 8.5, 53.0, 70.0, 40))
    for quarter in range(4):
        angle = 0.35 + 0.5 * math.pi * quarter
        reach = HOUSING_RADIUS - 3.7
        drawing.cut(cylinder(x + reach * math.cos(angle), y + reach * math.sin(angle), 1.8, 56.0, 70.0, 12))
    bridge = _outline([(-76, -13), (-40, -17), (-40, 46), (-76, 33)], 4.0)
    drawing.add(block(bridge, 0.0, 30.0, draft=1.5, edge=3.0))
    drawing.cut(
        block(bridge.offset(-wall, JoinType.Round, 2.0, 16), -1.0, 30.0 - wall)
        - cylinder(x, y, HOUSING_RADIUS - 1, -2, 40)
    )
    pad = box((-110.0, y - 20.0, 14.0), (-92.0, y + 20.0, 54.0))
    drawing.add(pad)
    drawing.cut(box((-106.0, y - 15.5, 10.0), (-93.0, y + 15.5, 50.0)) - cylinder(x, y, HOUSING_RADIUS - 0.8, 0, 60))


def draw_tower(drawing: Drawing, wall: float, top: float) -> None:
    """The hollow end tower with marker pads on top and on the end face, and the neck that ties it to the deck."""
    x, y = TOWER_CENTRE
    outline = _outline([(x - 22, y - 21.5), (x + 22, y - 21.5), (x + 22, y + 21.5), (x - 22, y + 21.5)], 5.0)
    drawing.add(block(outline, 0.0, top, draft=1.0, edge=0.8, edge_steps=2))
    drawing.cut(block(outline.offset(-wall, JoinType.Round, 2.0, 16), -1.0, top - wall, draft=1.0))
    drawing.add(box((x + 15.0, y - 19.0, 10.0), (x + 24.0, y + 19.0, 48.0)))
    neck = _outline([(40, -40), (66, -27), (66, 13), (40, 20)], 3.0)
    drawing.add(block(neck, 0.0, 27.0, draft=1.0, edge=3.0))
    drawing.cut(block(neck.offset(-wall, JoinType.Round, 2.0, 16), -1.0, 27.0 - wall))


def draw_port(drawing: Drawing, plate_thickness: float) -> None:
    """A side port towards +y with its oval bolting plate."""
    start = 50.0
    drawing.add(cylinder_y(PORT_X, PORT_Z, 13.0, 10.0, start + 1.0))
    drawing.cut(cylinder_y(PORT_X, PORT_Z, 9.0, 16.0, start + 40.0))
    oval = CrossSection.batch_hull(
        [CrossSection.circle(r, 28).translate((dx, dz)) for dx, dz, r in ((0, 0, 16.5), (-19, 0, 7.5), (19, 0, 7.5))]
    )
    plate = oval.extrude(plate_thickness).rotate((90.0, 0.0, 0.0)).translate((PORT_X, start + plate_thickness, PORT_Z))
    drawing.add(plate)
    for dx in (-19.0, 19.0):
        drawing.cut(cylinder_y(PORT_X + dx, PORT_Z, 3.2, start - 6.0, start + 40.0, 16))
    drawing.add(box((PORT_X - 3.0, 15.0, 2.0), (PORT_X + 3.0, start + 0.5, 10.0)))


def draw_flange(drawing: Drawing) -> None:
    """The base flange: an uneven rim around the decks, and five ears with spot-faced bolt holes."""
    thickness = 5.0
    for circles in (
        ((-50, -16, 8), (2, -16, 8), (2, 61, 8), (-46, 63, 8)),
        ((-2, -62, 8), (48, -64, 8), (50, 20, 8), (-2, 16, 8)),
        ((-80, 9, 31), (-44, -14, 8), (-44, 44, 8)),
        ((44, -38, 8), (95, -24, 9), (95, 11, 9), (44, 18, 8)),
        ((-46, -40, 9), (0, -34, 9), (0, -10, 6), (-48, -10, 9)),
        ((2, 52, 6), (52, 52, 6), (46, 16, 6), (6, 16, 6)),
    ):
        drawing.add(block(discs(*circles), 0.0, thickness, edge=1.5))
    anchors = [(-40.0, 52.0), (-40.0, -30.0), (40.0, -52.0), (84.0, 6.0), (44.0, 46.0)]
    for (x, y), (ax, ay) in zip(EARS, anchors, strict=True):
        drawing.add(block(discs((x, y, 11.5), (ax, ay, 13.0)), 0.0, 6.0, edge=1.5))
        drawing.add(block(discs((x, y, 9.0)), 2.0, 9.0, edge=0.8, edge_steps=2))
        drawing.cut(cylinder(x, y, 4.3, -1.0, 20.0, 20))
    # Windows in the flange where no body stands above: cast light.
    drawing.cut(block(_outline([(7, 24), (24, 24), (24, 46), (7, 46)], 4.0), -1.0, 9.0))
    drawing.cut(block(_outline([(34, 26), (48, 26), (48, 46), (34, 46)], 4.0), -1.0, 9.0))


def draw_webs(drawing: Drawing) -> None:
    """Stiffening webs between housing, tower, decks and flange."""
    ramp = [(0.0, 2.0), (1.0, 2.0), (1.0, 6.0), (0.0, 50.0)]
    for angle, reach in ((100.0, 12.0), (-95.0, 12.0)):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        r0, r1 = HOUSING_RADIUS - 2.0, HOUSING_RADIUS + reach - 7.0
        start = (HOUSING[0] + r0 * c, HOUSING[1] + r0 * s)
        end = (HOUSING[0] + r1 * c, HOUSING[1] + r1 * s)
        drawing.add(web(start, end, 5.0, ramp))
    drawing.add(web((60.0, -3.0), (52.0, -3.0), 6.0, [(0, 2), (1, 2), (1, 28), (0, 50)]))
    drawing.add(web((-62.0, 8.0), (-51.0, 8.0), 6.0, [(0, 2), (1, 2), (1, 32), (0, 56)]))
    drawing.add(web((16.0, -20.0), (-20.0, -42.0), 4.0, [(0.3, 2), (1, 2), (1, 6), (0.3, 30)]))


def draw(wall: float) -> Drawing:
    """Draw the whole part with walls of this thickness (mm)."""
    drawing = Drawing()
    draw_flange(drawing)
    draw_decks(drawing, wall)
    draw_housing(drawing, wall)
    draw_tower(drawing, wall, TOWER_TOP)
    draw_port(drawing, PORT_PLATE)
    draw_webs(drawing)
    draw_rib(drawing)
    return drawing


# --- from the drawing to files ----------------------------------------------------------------------------------------


def to_mesh(solid: Manifold) -> trimesh.Trimesh:
    """Convert to metres in the object frame, vertices on a 0.1 micrometre grid and in a canonical order."""
    raw = solid.to_mesh64() if hasattr(solid, "to_mesh64") else solid.to_mesh()
    vertices = np.asarray(raw.vert_properties, dtype=float)[:, :3].copy()
    vertices[:, 2] -= REST_HEIGHT
    mesh = trimesh.Trimesh(np.round(vertices * 1e-3, 7), np.asarray(raw.tri_verts), process=False)
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order))
    faces = rank[mesh.faces]
    first = np.argmin(faces, axis=1)
    faces = np.stack([np.take_along_axis(faces, ((first + k) % 3)[:, None], 1)[:, 0] for k in range(3)], axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    return trimesh.Trimesh(mesh.vertices[order], faces, process=False)


def solve_wall() -> float:
    """The wall thickness (mm) that gives the mass, rounded to 0.01 mm as a drawing would give it."""
    wall = brentq(lambda w: to_mesh(draw(w).solid()).volume * DENSITY - MASS, 2.0, 6.0, xtol=1e-3)
    return round(float(wall), 2)  # type: ignore[arg-type]  # a float, unless the full output is asked for


# Fiducials on the machined pads: number, centre in the drawing frame (mm), columns of the rotation (x, y, and z out of
# the face).
UP = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
TO_PLUS_X = ((0, 1, 0), (0, 0, 1), (1, 0, 0))
TO_MINUS_X = ((0, -1, 0), (0, 0, 1), (-1, 0, 0))
MARKER_SIZE = 30.0
MARKERS = [
    (0, (-25.0, 42.0, DECK + PAD_RISE), UP),
    (1, (25.5, -43.0, DECK + PAD_RISE), UP),
    (2, (TOWER_CENTRE[0], TOWER_CENTRE[1], TOWER_TOP), UP),
    (3, (TOWER_CENTRE[0] + 24.0, TOWER_CENTRE[1], 29.0), TO_PLUS_X),
    (4, (-110.0, HOUSING[1], 34.0), TO_MINUS_X),
]


def quat_wxyz(columns: tuple[Point3, Point3, Point3]) -> list[float]:
    """Unit quaternion of a rotation given by its columns."""
    rotation = np.eye(4)
    rotation[:3, :3] = np.array(columns, dtype=float).T
    return [round(float(c), 9) + 0.0 for c in trimesh.transformations.quaternion_from_matrix(rotation)]


def model_toml(mesh: trimesh.Trimesh, pieces: list[str], wall: float) -> str:
    """The part's model.toml, its mass properties from the mesh."""
    mesh.density = DENSITY
    com, inertia = mesh.center_mass, mesh.moment_inertia
    names = ",\n".join(f'    "{name}"' for name in pieces)
    grasp_z = (GRASP_HEIGHT - REST_HEIGHT) * 1e-3
    text = f"""\
# Written by scripts/make_casting.py; change the drawing there, not the numbers here.
kind = "object"
name = "casting"
description = "Engine casing: hollow aluminium casting with a machined rib of {2 * RIB_HALF_THICKNESS:g} mm"
# Metres, object frame. The mesh is the truth of mass and looks; the pieces stand for it in contact. They are the convex
# bodies that the part is drawn from (cores and bores, which no finger enters, left filled), not a decomposition.
mesh = "casting.stl"
pieces = [
{names},
]
# Uniform density of {DENSITY:g} kg/m3 (aluminium casting alloy, an assumption), walls of {wall:g} mm (solved for the
# mass).
mass = {mesh.mass:.6f}
centre_of_mass = [{com[0]:.6f}, {com[1]:.6f}, {com[2]:.6f}]
# World z of the object origin when the part stands on the ground: the paper draws its object positions at 0.1 m.
rest_height = {REST_HEIGHT * 1e-3:g}

# About the centre of mass, object axes (kg m2), from the mesh.
[inertia]
ixx = {inertia[0, 0]:.9f}
iyy = {inertia[1, 1]:.9f}
izz = {inertia[2, 2]:.9f}
ixy = {inertia[0, 1]:.9f}
ixz = {inertia[0, 2]:.9f}
iyz = {inertia[1, 2]:.9f}

# The pinch across the rib, {GRASP_HEIGHT:g} mm above the ground, from either side: z up, y across the rib, x along it.
[[grasps]]
name = "rib"
position = [0.0, 0.0, {grasp_z:g}]
quat_wxyz = [1.0, 0.0, 0.0, 0.0]
width = {2e-3 * RIB_HALF_THICKNESS:g}

[[grasps]]
name = "rib_flipped"
position = [0.0, 0.0, {grasp_z:g}]
quat_wxyz = [0.0, 0.0, 0.0, 1.0]
width = {2e-3 * RIB_HALF_THICKNESS:g}

# The inverted Gaussian of the approach. The paper gives 5 mm and 2 mm (read as standard deviations), not z_threshold.
[funnel]
z_threshold = 0.10
sigma_x = 0.005
sigma_y = 0.002

# Rubber pad on cast metal, the planner's assumption; 0.6 to 0.9 is plausible. Torsional (m): two thirds of the sliding
# coefficient times the radius of the contact patch, an assumption as well.
[friction]
sliding = 0.75
torsional = 0.0085
"""
    for number, (x, y, z), columns in MARKERS:
        text += f"""
[[markers]]
id = {number}
size = {MARKER_SIZE * 1e-3:g}
position = [{x * 1e-3:.6g}, {y * 1e-3:.6g}, {(z - REST_HEIGHT) * 1e-3:.6g}]
quat_wxyz = {quat_wxyz(columns)}
"""
    return text


def main() -> None:
    """Write mesh, pieces and model.toml."""
    wall = solve_wall()
    drawing = draw(wall)
    mesh = to_mesh(drawing.solid())
    OUTPUT.mkdir(parents=True, exist_ok=True)
    for stale in OUTPUT.glob("piece_*.stl"):
        stale.unlink()
    mesh.export(OUTPUT / "casting.stl")
    if not trimesh.load_mesh(OUTPUT / "casting.stl").is_watertight:
        raise SystemExit("the mesh is not closed any more in single precision")
    names = []
    for i, piece in enumerate(drawing.pieces):
        names.append(f"piece_{i:02d}.stl")
        to_mesh(piece).convex_hull.export(OUTPUT / names[-1])
    (OUTPUT / "model.toml").write_text(model_toml(mesh, names, wall), encoding="utf-8")
    com = 1e3 * mesh.center_mass
    print(f"walls {wall} mm, mass {mesh.mass:.4f} kg, {len(mesh.faces)} triangles, watertight {mesh.is_watertight}")
    print(f"centre of mass {com.round(2)} mm, {GRASP_HEIGHT - REST_HEIGHT - com[2]:.1f} mm below the pinch axis")
    print(f"bounds {mesh.bounds.round(4).tolist()} m, {len(names)} convex pieces")


if __name__ == "__main__":
    main()
