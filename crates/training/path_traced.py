# SPDX-License-Identifier: MIT OR Apache-2.0
# Licensed like the rest of the project. Blender is only used as a tool here: nothing of it
# is part of the project, and the pictures it renders are ours.
"""Path-traced training plates for the cross-recess detector.

Each plate is a painted, dirty sheet with a grid of worn cross-recessed screws and of things
that are no cross-recessed screws, modelled as real geometry, path-traced by Cycles and then
put through a small camera model (defocus, Bayer mosaic, noise, white balance, JPEG).

    python3 path_traced.py OUT --plates 60 --seed 1

writes OUT/rgb/plate_0001.jpg and OUT/truth/plate_0001.json, and so on. Plate k depends on
seed + k alone; plates whose two files exist are skipped. In the truth, pixel (0, 0) is the
centre of the top-left pixel, u runs right and v down. Lengths in the scene are millimetres,
the sheet lies in z = 0 with y up, and colours are linear.

Needs Python 3.11 with `pip install bpy==4.5.0 numpy pillow`.
"""

import argparse
import functools
import io
import json
import math
import os
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from PIL import Image, ImageFilter

SIZE = 940  # pixels, width and height of a plate
PIXEL = 0.32  # mm on the sheet
DISTANCE = 1500.0  # mm from the camera to the middle of the sheet
FOCAL = DISTANCE / PIXEL  # pixels
CELLS = 12
CELL = 74 * PIXEL
JITTER = 12 * PIXEL
TEXELS = 2048
TEXEL = 1.45 * SIZE * PIXEL / TEXELS
HALF_SHEET = TEXELS * TEXEL / 2
SPOKES = 128  # vertices around an item
RING_STEP = 0.15  # mm between its rings

SCREW_TYPES = ("pan", "truss", "binding", "washer", "hexflange")
# Base colour, metallic, roughness range, resistance to red rust.
PLATINGS = {
    "bright_zinc": ((0.62, 0.65, 0.69), 1.0, (0.20, 0.34), 0.2),
    "dull_zinc": ((0.42, 0.44, 0.46), 0.85, (0.42, 0.60), 0.1),
    "yellow_chromate": ((0.60, 0.44, 0.17), 0.95, (0.25, 0.42), 0.2),
    "black_oxide": ((0.018, 0.018, 0.020), 0.2, (0.32, 0.50), 0.0),
    "stainless": ((0.52, 0.50, 0.48), 1.0, (0.24, 0.40), 1.0),
    "nickel": ((0.62, 0.57, 0.50), 1.0, (0.17, 0.30), 0.6),
    "bronze": ((0.34, 0.20, 0.09), 1.0, (0.32, 0.48), 0.6),
    "painted": (None, 0.0, (0.35, 0.60), 0.3),
}
SHEETS = {
    "white": (0.74, 0.74, 0.72), "cream": (0.68, 0.62, 0.48), "grey": (0.33, 0.34, 0.35),
    "greenish": (0.36, 0.44, 0.36), "beige": (0.50, 0.42, 0.31), "dark": (0.07, 0.072, 0.08),
    "galvanised": (0.48, 0.50, 0.52),
}
NEGATIVES = {
    "slotted": 10, "hex_socket": 9, "torx": 8, "hex_bolt": 10, "hex_flange_bolt": 8,
    "rivet": 12, "hole": 5, "empty_screw_hole": 6, "plastic_cap": 7, "dimple": 5, "nut": 7,
    "blob": 5, "printed_mark": 9, "cross_emboss": 6, "button": 12,
}
SHEET_KINDS = ("hole", "empty_screw_hole", "dimple", "cross_emboss")
MUDS = ((0.10, 0.065, 0.04), (0.20, 0.14, 0.09), (0.05, 0.042, 0.035), (0.26, 0.22, 0.17))


# Small helpers.


def step(low, high, x):
    """The smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a, b, mask):
    """`a` where the mask is 0, `b` where it is 1, for colours and for scalars."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    mask = mask[..., None] if max(a.ndim, b.ndim) > mask.ndim or b.shape == (3,) else mask
    return a + (b - a) * mask


def soft_max(x, width):
    """max(x, 0) with its corner rounded over `width`."""
    return 0.5 * (x + np.sqrt(x * x + width * width))


def pick(rng, options):
    return options[int(rng.integers(len(options)))]


def axis_turn(axis, angle):
    return np.array(Matrix.Rotation(angle, 3, axis))


def spin(x, y, angle):
    c, s = math.cos(angle), math.sin(angle)
    return c * x + s * y, c * y - s * x


class Noise:
    """A tileable fractal field of mean 0 and deviation 1, looked up at any place."""

    SIDE = 1024
    CYCLES = 20

    def __init__(self, rng):
        f = np.fft.fftfreq(self.SIDE, 1 / self.SIDE)
        radius = np.hypot(f[:, None], f[None, :])
        white = np.fft.fft2(rng.standard_normal((self.SIDE, self.SIDE)))
        field = np.fft.ifft2(white * (self.CYCLES + radius) ** -1.9).real
        self.field = ((field - field.mean()) / field.std()).astype(np.float32)
        self.rng = rng

    def __call__(self, x, y, size):
        """Noise whose largest features measure about `size` in the unit of x and y."""
        scale = self.SIDE / self.CYCLES / (2 * size)
        a, b = self.rng.uniform(0, self.SIDE, 2)
        x, y = spin(x * scale, y * scale, self.rng.uniform(0, 6.28))
        x, y = x + a, y + b
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        fx, fy = x - i, y - j
        n = self.SIDE - 1
        g = self.field
        top = g[j & n, i & n] * (1 - fx) + g[j & n, (i + 1) & n] * fx
        low = g[(j + 1) & n, i & n] * (1 - fx) + g[(j + 1) & n, (i + 1) & n] * fx
        return top * (1 - fy) + low * fy


# Meshes.


@functools.lru_cache(maxsize=None)
def grid_faces(rows, columns, closed):
    """Quads of a grid of vertices, wrapping round its columns where closed."""
    i = np.arange(rows - 1)[:, None] * columns
    j = np.arange(columns if closed else columns - 1)[None, :]
    k = (j + 1) % columns
    return np.stack([i + j, i + columns + j, i + columns + k, i + k], -1).reshape(-1, 4)


class Parts:
    """Vertices, quads and surface attributes gathered for one mesh."""

    def __init__(self):
        self.points, self.faces, self.colours, self.surfaces = [], [], [], []
        self.count = 0

    def add(self, points, faces, colour, metallic, roughness):
        points = points.reshape(-1, 3)
        n = len(points)
        surface = np.zeros((n, 3))
        surface[:, 0] = np.broadcast_to(metallic, n)
        surface[:, 1] = np.broadcast_to(roughness, n)
        self.points.append(points)
        self.faces.append(faces + self.count)
        self.colours.append(np.broadcast_to(colour, (n, 3)))
        self.surfaces.append(surface)
        self.count += n

    def build(self, name, material):
        points = np.concatenate(self.points).astype(np.float32)
        faces = np.concatenate(self.faces).astype(np.int32)
        mesh = bpy.data.meshes.new(name)
        mesh.vertices.add(len(points))
        mesh.vertices.foreach_set("co", points.ravel())
        mesh.loops.add(faces.size)
        mesh.loops.foreach_set("vertex_index", faces.ravel())
        mesh.polygons.add(len(faces))
        mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 4, dtype=np.int32))
        colours = np.ones((len(points), 4), np.float32)
        colours[:, :3] = np.clip(np.concatenate(self.colours), 0, 1)
        layer = mesh.attributes.new("colour", "FLOAT_COLOR", "POINT")
        layer.data.foreach_set("color", colours.ravel())
        layer = mesh.attributes.new("surface", "FLOAT_VECTOR", "POINT")
        surfaces = np.concatenate(self.surfaces).astype(np.float32)
        layer.data.foreach_set("vector", surfaces.ravel())
        mesh.update()
        mesh.shade_smooth()
        mesh.materials.append(material)
        bpy.context.collection.objects.link(bpy.data.objects.new(name, mesh))


def dome(radius, height, power, n=24, start=0.0, base=0.0):
    """Profile points (r, z, hex weight) of a dome from r = start to r = radius."""
    t = np.linspace(0, math.pi / 2, n)
    r = np.sin(t) ** (2 / power) if power > 2 else np.sin(t)
    z = np.maximum(1 - r**power, 0) ** (1 / power)
    return [(start + (radius - start) * a, base + height * b, 0.0) for a, b in zip(r, z)]


def rings(profile, sag=4.0):
    """The profile resampled evenly, with an underside and a shaft of half its radius."""
    p = np.array(profile)
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(p[:, :2], axis=0).T))])
    s = np.linspace(0, length[-1], int(length[-1] / RING_STEP) + 2)
    p = np.stack([np.interp(s, length, p[:, k]) for k in range(3)], 1)
    r, z, h = p[-1]
    return np.vstack([p, [(r * 0.5, z, h), (r * 0.45, z - sag, 0.0)]])


def revolve(profile, turn=0.0):
    """x, y, z of the profile turned round, hexagonal by its third column."""
    a = np.linspace(0, 2 * math.pi, SPOKES, endpoint=False)
    wedge = (a - turn + math.pi / 6) % (math.pi / 3) - math.pi / 6
    hexagon = math.cos(math.pi / 6) / np.cos(wedge)
    p = rings(profile)
    r = p[:, :1] * (1 + p[:, 2:] * (hexagon[None, :] - 1))
    return r * np.cos(a), r * np.sin(a), np.repeat(p[:, 1:2], SPOKES, 1)


def head_profile(rng, kind, radius):
    """Profile of a screw head, from the middle of its top to the rim's underside."""
    if kind == "pan":
        return dome(radius, radius * rng.uniform(0.55, 0.75), rng.uniform(2.6, 4.0)) + [(radius, 0, 0)]
    if kind == "truss":
        rim = rng.uniform(0.3, 0.6)
        return dome(radius, radius * rng.uniform(0.34, 0.48), 2.0, base=rim) + [(radius, 0, 0)]
    if kind == "binding":
        rim = radius * rng.uniform(0.22, 0.32)
        top = dome(radius * 0.86, radius * rng.uniform(0.20, 0.32), 2.2, base=rim)
        return top + [(radius * 0.97, rim, 0), (radius, rim - 0.15, 0), (radius, 0, 0)]
    if kind == "washer":
        flange = rng.uniform(0.6, 1.2)
        inner = radius * rng.uniform(0.68, 0.78)
        top = dome(inner, inner * rng.uniform(0.45, 0.65), rng.uniform(2.4, 3.6), base=flange)
        return top + [(radius * 0.97, flange, 0), (radius, flange - 0.15, 0), (radius, 0, 0)]
    flange = rng.uniform(0.7, 1.2)
    corner = radius * rng.uniform(0.74, 0.84)
    high = radius * rng.uniform(0.45, 0.65) + flange
    return [(0, high, 1), (corner * 0.88, high, 1), (corner, high - 0.35, 1), (corner, flange + 0.2, 1),
            (radius * 0.96, flange * 0.8, 0), (radius, flange * 0.5, 0), (radius, 0, 0)]


def bolt_profile(rng, kind, radius):
    """Profile of a bolt head or nut without a cross; `radius` is its largest."""
    if kind == "hex_flange_bolt":
        profile = head_profile(rng, "hexflange", radius)
        dish = rng.uniform(0.0, 0.6)
        inner = profile[1][0] * rng.uniform(0.5, 0.85)
        high = profile[0][1]
        return [(0, high - dish, 1), (inner, high - dish, 0), (inner + 0.2, high, 0)] + profile[1:]
    high = radius * rng.uniform(0.6, 0.9)
    edge = [(radius * 0.85, high, 0), (radius, high - 0.4, 1), (radius, 0, 1)]
    if kind == "nut":
        stud, top = radius * rng.uniform(0.42, 0.55), high + rng.uniform(-0.3, 3.0)
        return [(0, top, 0), (stud - 0.3, top, 0), (stud, top - 0.3, 0), (stud, high - 0.8, 0),
                (stud + 0.3, high - 0.3, 0), (stud + 0.5, high, 0)] + edge
    if rng.random() < 0.35:
        return [(0, high, 0)] + edge[:2] + [(radius, 0.8, 1), (radius * 1.35, 0.8, 0), (radius * 1.35, 0, 0)]
    return [(0, high, 0)] + edge


def button_profile(rng, radius):
    """Profile of a push button, flat or a little hollow, most with a collar around a gap."""
    high, hollow = radius * rng.uniform(0.2, 0.8), radius * rng.uniform(-0.08, 0.12)
    edge = rng.uniform(0.1, 0.5)
    top = [(0, high - hollow, 0), (radius * 0.3, high - 0.9 * hollow, 0), (radius * 0.55, high - 0.6 * hollow, 0)]
    if rng.random() < 0.3:
        return top + [(radius - edge, high, 0), (radius, high - edge, 0), (radius, 0, 0)]
    inner, collar = min(radius * rng.uniform(0.66, 0.84), radius - 1.0), high * rng.uniform(0.5, 1.2)
    return top + [(inner - edge, high, 0), (inner, high - edge, 0), (inner, 0.2, 0), (inner + 0.35, 0.2, 0),
                  (inner + 0.35, collar - 0.15, 0), (inner + 0.5, collar, 0), (radius - 0.2, collar, 0), (radius, collar - 0.2, 0), (radius, 0, 0)]


# Recesses: depth in mm below the head's surface at each (x, y).


def bar_depth(x, y, length, width, corner, slope):
    """Depth of a straight-sided slot with rounded ends, growing at `slope` from its outline."""
    qx, qy = np.abs(x) - (length - corner), np.abs(y) - (width - corner)
    outside = np.hypot(np.maximum(qx, 0), np.maximum(qy, 0))
    return (corner - outside - np.minimum(np.maximum(qx, qy), 0)) * slope


class Cross:
    """A cross recess of random make and wear."""

    def __init__(self, rng, head, narrow):
        self.style = str(rng.choice(["phillips", "jis", "combination", "pozidriv"], p=[0.52, 0.22, 0.16, 0.10]))
        self.reach = head * rng.uniform(0.42, 0.52 if narrow else 0.62) / 2
        self.width = self.reach * rng.uniform(0.22, 0.38)
        self.corner = self.width * rng.uniform(0.1, 0.95)
        self.depth = rng.uniform(1.2, 2.5) * min(1.0, head / 10 + 0.15)
        self.slope = rng.uniform(3.5, 8.0)
        self.cone = rng.uniform(0.35, 0.75) * self.reach
        self.flare = rng.uniform(-0.25, 0.2)
        self.core = self.width * (rng.uniform(1.5, 2.1) if self.style == "phillips" else 1.2)
        self.round = rng.choice([0.03, 0.08, 0.2], p=[0.45, 0.35, 0.2]) * rng.uniform(0.7, 1.3)
        self.cam = rng.uniform(0.15, 0.5) * rng.choice([-1, 1]) if rng.random() < 0.22 else 0.0
        self.fill = rng.uniform(0.1, 0.9) if rng.random() < 0.3 else 0.0
        self.slot = (head * rng.uniform(0.40, 0.47), rng.uniform(0.42, 0.62), rng.uniform(0.6, 1.2))

    def wings(self, x, y, width):
        r = np.hypot(x, y)
        floor = self.depth * np.clip((self.reach - r) / self.cone, 0, 1) ** 0.8 + 0.15 * (r < self.reach)
        wide = width * (1 + self.flare * (r / self.reach - 0.5))
        corner = min(self.corner, 0.95 * width)
        bars = np.maximum(bar_depth(x, y, self.reach, wide, corner, self.slope),
                          bar_depth(y, x, self.reach, wide, corner, self.slope))
        return np.minimum(floor, np.maximum(bars, (self.core - r) * self.slope))

    def __call__(self, x, y):
        """Depth, and the mask of what fills the recess."""
        depth = self.wings(x, y, self.width)
        if self.cam:
            for share, shallow in ((0.5, 0.65), (1.0, 0.35)):
                turned = spin(x, y, self.cam * share)
                depth = np.maximum(depth, shallow * self.wings(*turned, self.width * 1.15))
        if self.style == "combination":
            length, width, deep = self.slot
            depth = np.maximum(depth, np.minimum(bar_depth(x, y, length, width, 0.05, self.slope), deep))
        if self.style == "pozidriv":  # marks between the wings
            p, q = spin(x, y, math.pi / 4)
            marks = np.maximum(bar_depth(p, q, self.reach * 1.1, 0.16, 0.02, 3), bar_depth(q, p, self.reach * 1.1, 0.16, 0.02, 3))
            depth = np.maximum(depth, np.minimum(marks, 0.2))
        depth = soft_max(depth, self.round)
        level = self.depth * (1 - self.fill) if self.fill else 9.0
        return np.minimum(depth, level), step(level - 0.05, level + 0.05, depth)


def negative_recess(rng, kind, radius):
    """The recess of a screw that is not cross-recessed, as a function of (x, y)."""
    deep, slope = rng.uniform(0.9, 2.0), rng.uniform(4, 8)
    if kind == "slotted":
        length = radius * rng.choice([rng.uniform(0.6, 0.85), 1.2])
        width = radius * rng.uniform(0.09, 0.17)
        return lambda x, y: np.minimum(bar_depth(x, y, length, width, 0.05, slope), deep)
    if kind == "hex_socket":
        size = radius * rng.uniform(0.40, 0.55)

        def depth(x, y):
            wedge = (np.arctan2(y, x) + math.pi / 6) % (math.pi / 3) - math.pi / 6
            return np.minimum((size - np.hypot(x, y) * np.cos(wedge)) * slope, deep * 1.4)
        return depth
    size, lobes = radius * rng.uniform(0.36, 0.5), rng.uniform(0.10, 0.15)
    return lambda x, y: np.minimum(
        (size * (1 + lobes * np.cos(6 * np.arctan2(y, x))) - np.hypot(x, y)) * slope, deep)


# Signs, as they are printed or moulded: how far inside of its ink a point is, in mm.


def ring_sign(radius, line):
    return lambda x, y: line / 2 - np.abs(np.hypot(x, y) - radius)


def frame(rng, radius):
    """A ring or a rectangle around a sign."""
    line = radius * rng.uniform(0.06, 0.16)
    if rng.random() < 0.6:
        return ring_sign(radius * 0.95, line)
    half = radius * np.array([rng.uniform(0.6, 0.8), rng.uniform(0.6, 0.8)])
    return lambda x, y: line / 2 - np.abs(np.maximum(np.abs(x) - half[0], np.abs(y) - half[1]))


def stroke(x, y, ends, line):
    """Inside a straight line with round ends."""
    ends = np.array(ends, float)
    way = ends[1] - ends[0]
    along = np.clip(((x - ends[0, 0]) * way[0] + (y - ends[0, 1]) * way[1]) / (way @ way), 0, 1)
    return line / 2 - np.hypot(x - ends[0, 0] - along * way[0], y - ends[0, 1] - along * way[1])


# Strokes in a box of -1 to 1; `power` and `turn` have an arc beside them.
SIGNS = {
    "plus": [((-1, 0), (1, 0)), ((0, -1), (0, 1))],
    "minus": [((-1, 0), (1, 0))],
    "times": [((-0.8, -0.8), (0.8, 0.8)), ((-0.8, 0.8), (0.8, -0.8))],
    "up": [((-0.8, -0.4), (0, 0.6)), ((0, 0.6), (0.8, -0.4))],
    "arrow": [((0, -1), (0, 1)), ((0, 1), (-0.5, 0.4)), ((0, 1), (0.5, 0.4))],
    "four": [((-1, 0), (1, 0)), ((0, -1), (0, 1))] + [
        ((a, b), (a * 0.7 + 0.25 * c * b, b * 0.7 + 0.25 * c * a)) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)) for c in (1, -1)],
    "play": [((-0.6, -0.8), (-0.6, 0.8)), ((-0.6, 0.8), (0.8, 0)), ((0.8, 0), (-0.6, -0.8))],
    "pause": [((-0.4, -0.8), (-0.4, 0.8)), ((0.4, -0.8), (0.4, 0.8))],
    "menu": [((-0.8, h), (0.8, h)) for h in (-0.6, 0, 0.6)],
    "ground": [((0, 1), (0, 0)), ((-0.9, 0), (0.9, 0)), ((-0.6, -0.4), (0.6, -0.4)), ((-0.25, -0.8), (0.25, -0.8))],
    "power": [((0, 0.1), (0, 1.1))],
    "turn": [((-0.95, 0.25), (-0.6, 0.75)), ((-0.35, 0.3), (-0.95, 0.25))],
    "dot": [((-0.05, 0), (0.05, 0))],
    "H": [((-0.6, -1), (-0.6, 1)), ((0.6, -1), (0.6, 1)), ((-0.6, 0), (0.6, 0))],
    "T": [((-0.8, 1), (0.8, 1)), ((0, 1), (0, -1))],
    "A": [((-0.7, -1), (0, 1)), ((0, 1), (0.7, -1)), ((-0.4, -0.3), (0.4, -0.3))],
    "4": [((0.4, -1), (0.4, 1)), ((0.4, 1), (-0.7, -0.3)), ((-0.7, -0.3), (0.8, -0.3))],
    "8": [((-0.5, -0.9), (0.5, -0.9)), ((-0.5, 0), (0.5, 0)), ((-0.5, 0.9), (0.5, 0.9)), ((-0.6, -0.9), (-0.6, 0.9)), ((0.6, -0.9), (0.6, 0.9))],
    "sun": [((0.55 * math.cos(a), 0.55 * math.sin(a)), (math.cos(a), math.sin(a))) for a in np.arange(8) * math.pi / 4],
}


def sign(rng, radius, crosses=False):
    """A sign of about the given radius; a cross only where it lies flat, since raised or sunk it may as well be a recess."""
    names = [name for name in SIGNS if crosses or name not in ("plus", "times", "four")]
    name = "plus" if crosses and rng.random() < 0.3 else pick(rng, names)
    line = radius * rng.uniform(0.14, 0.42)
    strokes = [np.array(ends) * radius for ends in SIGNS[name]]

    def inside(x, y):
        shade = np.max([stroke(x, y, ends, line) for ends in strokes], axis=0)
        if name in ("power", "turn"):
            gap = np.abs(np.arctan2(x, y)) > 0.6
            shade = np.maximum(shade, np.where(gap, line / 2 - np.abs(np.hypot(x, y) - 0.8 * radius), -9.0))
        return shade
    turn = rng.uniform(-0.2, 0.2) + rng.choice([0, math.pi / 2, rng.uniform(0, 6.28)], p=[0.6, 0.15, 0.25])
    return lambda x, y: inside(*spin(x, y, turn))


# Surfaces.


class Skin:
    """Colour, metallic and roughness of an item's vertices, and the height its wear adds."""

    def __init__(self, noise, x, y, colour, metallic, roughness):
        self.noise, self.x, self.y = noise, x, y
        self.colour = np.broadcast_to(colour, x.shape + (3,)).astype(float)
        self.metallic = np.full(x.shape, float(metallic))
        self.roughness = np.full(x.shape, float(roughness))
        self.height = np.zeros(x.shape)

    def cover(self, mask, colour, metallic, roughness, height=0.0):
        self.colour = mix(self.colour, colour, mask)
        self.metallic = mix(self.metallic, metallic, mask)
        self.roughness = mix(self.roughness, roughness, mask)
        self.height = self.height + mask * height

    def fractal(self, size):
        return self.noise(self.x, self.y, size)


def rust_colour(rng, n):
    """Brown to orange by the noise n."""
    dark = np.array([0.085, 0.034, 0.016]) * rng.uniform(0.5, 1.4)
    light = np.array([0.36, 0.13, 0.035]) * rng.uniform(0.6, 1.2)
    return mix(dark, light, step(-1.5, 1.8, n + rng.uniform(-0.8, 0.8)))


def plated_skin(rng, noise, plating, sheet, x, y):
    colour, metallic, rough, _ = PLATINGS[plating]
    colour = np.array(sheet if colour is None else colour) * rng.uniform(0.85, 1.1)
    skin = Skin(noise, x, y, colour, metallic, rng.uniform(*rough))
    skin.colour *= 1 + 0.06 * skin.fractal(4)[..., None]
    skin.roughness += 0.04 * skin.fractal(1.5)
    if plating == "yellow_chromate":
        skin.cover(step(-0.5, 1.5, skin.fractal(3)), (0.52, 0.42, 0.30), 1.0, 0.33)
    return skin


def chip_coating(rng, skin, sheet):
    """Flakes with sharp borders that show the metal, rust or another coat."""
    n = skin.fractal(rng.uniform(1.5, 5)) + 0.4 * skin.fractal(0.6)
    edge = rng.uniform(0.4, 1.8)
    below = pick(rng, ["bare", "rust", "primer", "paint"])
    mask = step(edge, edge + 0.06, n)
    if below == "bare":
        skin.cover(mask, (0.40, 0.39, 0.38), 0.9, 0.4, -0.04)
    elif below == "rust":
        skin.cover(mask, rust_colour(rng, skin.fractal(1.0)), 0.0, 0.9, -0.02)
    elif below == "primer":
        skin.cover(mask, pick(rng, [(0.25, 0.08, 0.05), (0.3, 0.3, 0.29), (0.55, 0.5, 0.4)]), 0, 0.7, -0.04)
    else:
        skin.cover(mask, sheet, 0.0, 0.45, 0.05)


def weather(rng, skin, plating, level, cavity, edge):
    """Red rust, white rust, dust and grime; `level` runs from 0 (new) to about 1.2."""
    resistance = PLATINGS[plating][3] if plating in PLATINGS else 2.0
    grime = rng.uniform(0.1, 1.0) * (0.25 + level)
    mask = step(0.9, 2.4, skin.fractal(5) + 1.0 * edge + 1.2 * cavity + grime) * min(1, grime)
    skin.cover(0.85 * mask, pick(rng, MUDS), 0.0, 0.85)
    # white rust of zinc; lime and what other metals shed, on anything
    if rng.random() < (0.2 + 0.5 * level if plating.endswith("zinc") else 0.08 + 0.3 * level):
        t = 1.9 - 1.5 * level * rng.random()
        mask = step(t, t + 0.7, skin.fractal(2.5) + 0.3 * skin.fractal(0.7))
        skin.cover(mask, (0.55, 0.55, 0.53), 0.0, 0.9, 0.04)
    t = 2.9 + resistance - 3.1 * level * rng.uniform(0.5, 1.15)
    n = 0.9 * skin.fractal(rng.uniform(2, 7)) + 0.4 * skin.fractal(0.8) + 0.5 * edge + 0.5 * cavity
    mask = step(t, t + rng.uniform(0.15, 1.0), n)
    bumps = rng.uniform(0.03, 0.12) * (1 + skin.fractal(0.7))
    skin.cover(mask, rust_colour(rng, skin.fractal(1.2)), 0.0, 0.92, bumps)
    if rng.random() < 0.5:
        upper = skin.y / (np.abs(skin.y).max() + 1e-6)
        t = rng.uniform(0.2, 1.8) - level
        dust = step(t, t + 1.6, 0.7 * upper + 0.5 * skin.fractal(3)) * rng.uniform(0.2, 0.75)
        skin.cover(dust, (0.30, 0.26, 0.21), 0.0, 0.95)


def wear_level(rng):
    third = int(rng.integers(3))
    return ("clean", "medium", "heavy")[third], rng.uniform(*((0.0, 0.2), (0.35, 0.7), (0.75, 1.2))[third])


# The sheet: a texture of colour and roughness, and fine patches where it is not flat.


class Sheet:
    def __init__(self, rng, noise):
        self.rng, self.noise = rng, noise
        self.name = pick(rng, list(SHEETS))
        self.metallic = 0.75 if self.name == "galvanised" else 0.0
        self.base = np.clip(np.array(SHEETS[self.name]) * rng.uniform(0.85, 1.12) * rng.uniform(0.97, 1.03, 3), 0, 0.85)
        self.texture = np.empty((TEXELS, TEXELS, 4), np.float32)
        self.texture[..., :3] = self.base
        self.texture[..., 3] = rng.uniform(0.25, 0.6)
        self.patches = {}
        self.dirty()

    def paint(self, window, mask, colour, roughness):
        area = self.texture[window]
        area[..., :3] = mix(area[..., :3], np.asarray(colour), mask)
        area[..., 3] += (roughness - area[..., 3]) * mask

    def around(self, x, y, reach):
        """The texture's window around a place, and its offsets from it in mm."""
        i, j, n = (int((c + HALF_SHEET) / TEXEL) for c in (x, y, reach - HALF_SHEET))
        rows = slice(max(j - n, 0), min(j + n, TEXELS))
        columns = slice(max(i - n, 0), min(i + n, TEXELS))
        dy = (np.arange(rows.start, rows.stop) + 0.5) * TEXEL - HALF_SHEET - y
        dx = (np.arange(columns.start, columns.stop) + 0.5) * TEXEL - HALF_SHEET - x
        return (rows, columns), *np.meshgrid(dx, dy)

    def dirty(self):
        """Grime gradients, blotches of rust, speckles and thin scratches."""
        rng, noise = self.rng, self.noise
        whole, x, y = self.around(0, 0, HALF_SHEET)
        level = rng.uniform(0, 1) ** 1.5
        self.texture[..., :3] *= 1 + 0.04 * noise(x, y, rng.uniform(20, 90))[..., None].astype(np.float32)
        slope = (x * rng.uniform(-1, 1) + y * rng.uniform(-1, 1)) / HALF_SHEET
        mask = step(0.2, 2.6, noise(x, y, rng.uniform(15, 80)) + slope) * level * 0.8
        self.paint(whole, mask, pick(rng, MUDS), 0.8)
        fine = noise(x, y, rng.uniform(0.8, 2.5))
        t = rng.uniform(2.4, 3.4) - 0.5 * level
        self.paint(whole, 0.8 * step(t, t + 0.3, fine), pick(rng, MUDS), 0.8)
        if rng.random() < 0.6:
            t = rng.uniform(1.8, 3.2) - 0.6 * level
            spots = noise(x, y, rng.uniform(5, 25)) + 0.25 * fine
            self.paint(whole, step(t, t + 0.3, spots), rust_colour(rng, fine), 0.9)
        for _ in range(int(rng.integers(0, 14))):
            self.scratch()

    def scratch(self):
        rng = self.rng
        s = np.linspace(0, 1, 4000)
        angle, length, bend = rng.uniform(0, 6.28), rng.uniform(10, 120), rng.normal(0, 4)
        x0, y0 = rng.uniform(-0.7, 0.7, 2) * HALF_SHEET
        x = x0 + length * s * math.cos(angle) + bend * s * s
        y = y0 + length * s * math.sin(angle) + bend * np.sin(3 * s)
        i, j = (np.clip((c + HALF_SHEET) / TEXEL, 0, TEXELS - 1).astype(int) for c in (x, y))
        tint = pick(rng, [np.array([0.4, 0.4, 0.4]), self.base * 0.5, self.base * 1.3, np.array([0.15, 0.06, 0.03])])
        self.texture[j, i, :3] = 0.4 * self.texture[j, i, :3] + 0.6 * np.clip(tint, 0, 0.9)

    def halo(self, x, y, radius, level, resistance):
        """Rust or dirt around an item and running down below it."""
        rng = self.rng
        strength = rng.uniform(0, 0.9) * min(level * 1.1, 1)
        if strength < 0.08:
            return
        window, dx, dy = self.around(x, y, radius * 2 + 14)
        n = self.noise(dx, dy, 4)
        r = np.hypot(dx, dy) / radius
        ring = step(1.0 + rng.uniform(0.15, 0.8), 0.9, r + 0.12 * n)
        run = step(rng.uniform(0.4, 0.9), 0.1, np.abs(dx + 0.3 * n) / radius) * (dy < 0)
        run = run * np.exp(dy / rng.uniform(3, 10)) * step(-0.8, 1.0, self.noise(dx, dy * 0.15, 2) + 0.5)
        colour = rust_colour(rng, n) if rng.random() < 0.65 - 0.3 * resistance else pick(rng, MUDS)
        self.paint(window, strength * np.maximum(ring, run * rng.random()), colour, 0.85)

    def mark(self, x, y, radius):
        """A printed sign, bare, in a frame, on a disc, or a ring alone."""
        rng = self.rng
        window, dx, dy = self.around(x, y, radius + 2)
        kind = str(rng.choice(["bare", "framed", "disc", "ring"]))
        if kind == "bare":
            shade = sign(rng, radius * 0.9, True)(dx, dy)
        elif kind == "framed":
            shade = np.maximum(frame(rng, radius)(dx, dy), sign(rng, radius * rng.uniform(0.4, 0.6), True)(dx, dy))
        elif kind == "disc":
            shade = np.minimum(radius - np.hypot(dx, dy), -sign(rng, radius * rng.uniform(0.4, 0.65), True)(dx, dy))
        else:
            shade = ring_sign(radius * 0.95, radius * rng.uniform(0.05, 0.15))(dx, dy)
        wear = step(-2.2, -1.4, self.noise(dx, dy, 2) + rng.uniform(-0.6, 1))
        ink = pick(rng, [(0.03, 0.03, 0.03), (0.35, 0.03, 0.03), (0.03, 0.08, 0.3), (0.75, 0.75, 0.75)])
        if abs(float(np.mean(ink)) - float(self.base.mean())) < 0.15:
            ink = (0.03, 0.03, 0.03) if self.base.mean() > 0.2 else (0.7, 0.7, 0.7)
        self.paint(window, step(-0.1, 0.1, shade) * wear, ink, 0.5)

    def press(self, cell, kind, x, y, radius):
        """Make a cell's patch of the sheet three-dimensional."""
        rng = self.rng
        window, dx, dy = self.around(x, y, radius + 3)
        r = np.hypot(dx, dy)
        if kind == "dimple":
            deep = rng.uniform(0.8, 2.2) * rng.choice([1, 1, -0.7])
            flat = radius * rng.uniform(0.1, 0.7)
            shape = lambda x, y: -deep * step(radius, flat, np.hypot(x, y))
        elif kind == "cross_emboss":
            high, width = rng.uniform(0.25, 0.9) * rng.choice([-1, 1]), radius * rng.uniform(0.14, 0.3)
            turn, corner = rng.uniform(0, 1.6), width * rng.uniform(0.2, 0.95)

            def shape(x, y):
                x, y = spin(x, y, turn)
                bars = np.maximum(bar_depth(x, y, radius, width, corner, 1), bar_depth(y, x, radius, width, corner, 1))
                return high * step(-0.15, 0.35, bars)
        else:
            sink = rng.uniform(0, 0.8) * (kind == "empty_screw_hole")
            shape = lambda x, y: np.where(np.hypot(x, y) < radius, -9.0, -sink * step(radius * 2, radius, np.hypot(x, y)))
            self.paint(window, step(radius + 0.08, radius - 0.08, r), (0.006, 0.006, 0.006), 0.95)
            if rng.random() < 0.6:
                self.paint(window, step(radius + rng.uniform(0.2, 1), radius, r + 0.2 * self.noise(dx, dy, 2)) * (r > radius),
                           rust_colour(rng, r), 0.9)
        self.patches[cell] = lambda px, py: shape(px - x, py - y)

    def build(self):
        parts = Parts()
        edges = (np.arange(CELLS + 1) - CELLS / 2) * CELL
        edges[0], edges[-1] = -HALF_SHEET, HALF_SHEET
        for row in range(CELLS):
            for column in range(CELLS):
                shape = self.patches.get((row, column))
                inner = (np.array([row, row + 1, column, column + 1]) - CELLS / 2) * CELL
                if shape is None:
                    y, x = edges[row:row + 2], edges[column:column + 2]
                else:
                    y, x = (np.linspace(*inner[k:k + 2], 160) for k in (0, 2))
                    y[[0, -1]], x[[0, -1]] = edges[row:row + 2], edges[column:column + 2]
                x, y = np.meshgrid(x, y)
                z = np.zeros_like(x) if shape is None else shape(x, y)
                faces = grid_faces(*x.shape, False)[:, ::-1]
                parts.add(np.stack([x, y, z], -1), faces, 0.5, 0.0, 0.5)
        parts.build("sheet", sheet_material(self))


# Items.


class Camera:
    """A pinhole looking at the middle of the sheet."""

    def __init__(self, rng):
        tilt = math.radians(rng.uniform(8, 40) if rng.random() < 0.3 else rng.uniform(0, 6))
        toward = rng.uniform(0, 2 * math.pi)
        lean = axis_turn("Z", toward) @ axis_turn("X", tilt) @ axis_turn("Z", -toward)
        self.turn = lean @ axis_turn("Z", math.radians(rng.uniform(-4, 4)))
        self.place = self.turn @ np.array([0, 0, DISTANCE])

    def project(self, points):
        p = (np.asarray(points) - self.place) @ self.turn
        middle = SIZE / 2 - 0.5
        return np.stack([middle - FOCAL * p[..., 0] / p[..., 2], middle + FOCAL * p[..., 1] / p[..., 2]], -1)

    def build(self):
        data = bpy.data.cameras.new("camera")
        data.sensor_width, data.lens = 36.0, 36.0 * FOCAL / SIZE
        data.clip_start, data.clip_end = 100.0, 10000.0
        camera = bpy.data.objects.new("camera", data)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn, self.place
        camera.matrix_world = Matrix(pose.tolist())
        bpy.context.collection.objects.link(camera)
        bpy.context.scene.camera = camera


class Pose:
    """How an item sits on the sheet: a small tilt and a lift."""

    def __init__(self, rng, x, y, radius, seated):
        tilt = 0.0 if seated else min(abs(rng.normal(0, math.radians(2.2))), math.radians(6))
        if not seated and rng.random() < 0.08:
            tilt = math.radians(rng.uniform(4, 12))
        toward = rng.uniform(0, 6.28)
        self.turn = axis_turn("Z", toward) @ axis_turn("X", tilt) @ axis_turn("Z", -toward)
        self.lift = rng.uniform(0.3, 3.5) if not seated and rng.random() < 0.25 else 0.0
        self.tilted = tilt > math.radians(2.5)
        self.place = np.array([x, y, self.lift + radius * math.sin(tilt)])

    def __call__(self, points):
        return points @ self.turn.T + self.place


def add_item(parts, pose, x, y, z, skin):
    points = np.stack([x, y, z + skin.height], -1)
    faces = grid_faces(*x.shape, True)
    parts.add(pose(points.reshape(-1, 3)), faces, skin.colour.reshape(-1, 3),
              skin.metallic.ravel(), skin.roughness.ravel())


def choose_plating(rng):
    # black heads are the hardest to read and so come more often than on a unit
    return str(rng.choice(list(PLATINGS), p=[0.16, 0.16, 0.12, 0.20, 0.10, 0.07, 0.06, 0.13]))


def rim_mask(x, y, radius):
    return step(0.75, 1.0, np.hypot(x, y) / radius)


def add_screw(rng, noise, sheet, parts, x0, y0):
    """A cross-recessed screw; returns its truth, still without pixels."""
    kind, plating = pick(rng, SCREW_TYPES), choose_plating(rng)
    head = rng.uniform(8.5 if kind in ("washer", "hexflange") else 7.0, 12.0)
    wear, level = wear_level(rng)
    cross, turn = Cross(rng, head, kind in ("washer", "hexflange")), rng.uniform(0, 6.28)
    pose = Pose(rng, x0, y0, head / 2, False)
    x, y, z = revolve(head_profile(rng, kind, head / 2), rng.uniform(0, 1))
    depth, filled = cross(*spin(x, y, turn))
    filled[-4:] = 0
    inside = np.hypot(x, y) < head * 0.5
    inside[-4:] = False
    depth = depth * inside
    skin = plated_skin(rng, noise, plating, sheet.base, x, y)
    chipped = rng.random() < (0.5 if plating in ("painted", "black_oxide") else 0.2) * (0.4 + level)
    if chipped:
        chip_coating(rng, skin, sheet.base)
    weather(rng, skin, plating, level, step(0.3, 1.5, depth), rim_mask(x, y, head / 2))
    if cross.fill:
        paint = rng.random() < 0.35
        colour = sheet.base if paint else np.array(pick(rng, MUDS))
        skin.cover(filled, colour * (1 + 0.15 * skin.fractal(1)[..., None]), 0.0, 0.45 if paint else 0.95, 0.06 * skin.fractal(0.8))
    rim = np.hypot(x, y)[:, 0]
    rim_z = float(np.interp(cross.reach * 0.8, rim[:-4], z[:-4, 0]))
    add_item(parts, pose, x, y, z - depth, skin)
    sheet.halo(x0, y0, head / 2, level, PLATINGS[plating][3])
    tags = [f"rust_{wear}" if wear != "clean" else "clean", cross.style]
    checks = {"cam_out": cross.cam, "filled": cross.fill > 0.3, "chipped": chipped,
              "unseated": pose.lift > 0, "tilted": pose.tilted}
    tags += [name for name, holds in checks.items() if holds]
    a = np.linspace(0, 6.28, 24, endpoint=False)
    spots = np.concatenate([[[0, 0, rim_z]]] + [
        np.stack([cross.reach * f * np.cos(a), cross.reach * f * np.sin(a), np.full(24, rim_z)], -1)
        for f in (0.3, 0.55, 0.75, 0.9, 1.0)])
    return {"spots": pose(spots), "mm": head, "readable": not (cross.fill > 0.85 or cross.fill > 0.7 and wear == "heavy"),
            "type": kind, "plating": plating, "tags": tags}


def negative_shape(rng, kind, radius):
    """Profile and recess of an item without a cross."""
    flat = lambda x, y: np.full(x.shape, -1.0)
    if kind in ("slotted", "torx"):
        return head_profile(rng, pick(rng, SCREW_TYPES), radius), negative_recess(rng, kind, radius)
    if kind == "hex_socket":
        high = radius * rng.uniform(0.6, 1.3)
        cap = [(0, high, 0), (radius - 0.4, high, 0), (radius, high - 0.4, 0), (radius, 0, 0)]
        profile = cap if rng.random() < 0.6 else head_profile(rng, "pan", radius)
        return profile, negative_recess(rng, kind, radius)
    if kind == "rivet":
        profile = dome(radius, radius * rng.uniform(0.3, 0.55), 2.0, base=0.2) + [(radius, 0, 0)]
        pin = radius * rng.uniform(0.2, 0.32)
        deep = rng.choice([0.0, rng.uniform(0.3, 2.0)], p=[0.35, 0.65])
        return profile, lambda x, y: np.minimum((pin - np.hypot(x, y)) * 7, deep)
    if kind == "plastic_cap":
        return dome(radius, radius * rng.uniform(0.3, 0.9), rng.uniform(2, 4), base=0.3) + [(radius, 0, 0)], flat
    if kind == "button":
        return button_profile(rng, radius), flat
    if kind == "blob":
        return dome(radius, radius * rng.uniform(0.15, 0.5), 2.0) + [(radius, -0.2, 0)], flat
    return bolt_profile(rng, kind, radius), flat


def add_solid(rng, noise, sheet, parts, kind, x0, y0, radius):
    """Anything that is not a cross-recessed screw and not part of the sheet itself."""
    wear, level = wear_level(rng)
    pose = Pose(rng, x0, y0, radius, kind in ("blob", "plastic_cap", "button", "rivet"))
    profile, recess = negative_shape(rng, kind, radius)
    x, y, z = revolve(profile, rng.uniform(0, 1))
    if kind == "blob":
        grow = 1 + 0.16 * noise(3 * x / (np.hypot(x, y) + 0.5), 3 * y / (np.hypot(x, y) + 0.5), 2)
        x, y, z = x * grow, y * grow, z * (1 + 0.15 * noise(x, y, 2))
    depth = soft_max(recess(*spin(x, y, rng.uniform(0, 6.28))), 0.04)
    depth[-4:] = 0
    plating = choose_plating(rng)
    if kind == "hex_bolt" and rng.random() < 0.5:
        # what a maker's mark raises or sinks
        mark = rng.uniform(0.08, 0.25) * rng.choice([-1, 1]) * step(-0.1, 0.1, sign(rng, radius * rng.uniform(0.3, 0.6))(x, y))
        depth = depth + mark * (np.hypot(x, y) < 0.75 * radius)
    if kind == "blob":
        skin = Skin(noise, x, y, pick(rng, MUDS), 0.0, 0.95)
        skin.colour *= 1 + 0.2 * skin.fractal(1)[..., None]
        skin.height = 0.12 * skin.fractal(0.8)
    elif kind == "plastic_cap":
        colour = pick(rng, [sheet.base, (0.02, 0.02, 0.02), (0.7, 0.7, 0.68), (0.3, 0.3, 0.3), (0.4, 0.05, 0.04), (0.05, 0.1, 0.4)])
        skin = Skin(noise, x, y, colour, 0.0, rng.uniform(0.25, 0.6))
        weather(rng, skin, "plastic", 0.5 * level, 0.0 * x, rim_mask(x, y, radius))
    elif kind == "button":
        skin, depth = button_skin(rng, noise, sheet, x, y, radius)
        weather(rng, skin, "plastic", 0.4 * level, step(0.1, 0.4, depth), rim_mask(x, y, radius))
    else:
        skin = plated_skin(rng, noise, plating, sheet.base, x, y)
        if rng.random() < 0.3 * (0.4 + level):
            chip_coating(rng, skin, sheet.base)
        weather(rng, skin, plating, level, step(0.3, 1.5, depth), rim_mask(x, y, radius))
        sheet.halo(x0, y0, radius, level, PLATINGS[plating][3])
    add_item(parts, pose, x, y, z - depth, skin)


def button_skin(rng, noise, sheet, x, y, radius):
    """A button's surface with its sign, and the depth of a sign that is moulded."""
    metal = rng.random() < 0.25
    colour = np.array(pick(rng, [sheet.base, (0.02, 0.02, 0.02), (0.02, 0.02, 0.022), (0.75, 0.75, 0.73), (0.3, 0.3, 0.31), (0.15, 0.15, 0.16), (0.4, 0.05, 0.04), (0.05, 0.1, 0.4)]))
    if metal:
        colour = np.array((0.55, 0.55, 0.56)) * rng.uniform(0.5, 1.1)
    skin = Skin(noise, x, y, colour, float(metal), rng.uniform(0.2, 0.6))
    drawn = sign(rng, radius * rng.uniform(0.3, 0.6))(x, y)
    if rng.random() < 0.3:
        drawn = np.maximum(sign(rng, radius * rng.uniform(0.25, 0.35))(x, y), frame(rng, 0.6 * radius)(x, y))
    on_top = np.hypot(x, y) < 0.64 * radius
    ink = (0.75, 0.75, 0.75) if colour.mean() < 0.25 else pick(rng, [(0.02, 0.02, 0.02), (0.15, 0.15, 0.15), (0.4, 0.03, 0.03), (0.03, 0.08, 0.35)])
    how = str(rng.choice(["printed", "moulded", "both", "none"], p=[0.5, 0.2, 0.15, 0.15]))
    shade = step(-0.08, 0.08, drawn) * on_top
    if how in ("printed", "both"):
        skin.cover(shade * step(-2.4, -1.6, skin.fractal(1.5)), ink, 0.0, 0.5)
    sunk = rng.uniform(0.1, 0.5) * rng.choice([1, 1, -1]) if how in ("moulded", "both") else 0.0
    return skin, sunk * shade


def add_negative(rng, noise, sheet, parts, cell, x0, y0):
    weights = np.array(list(NEGATIVES.values()), float)
    kind = str(rng.choice(list(NEGATIVES), p=weights / weights.sum()))
    radius = rng.uniform(3.0, 6.0)
    if kind in ("hole", "empty_screw_hole"):
        radius = rng.uniform(1.0, 2.2) if kind == "empty_screw_hole" else rng.uniform(2.0, 4.5)
    elif kind == "cross_emboss":
        radius = rng.uniform(2.0, 4.5)
    if kind == "printed_mark":
        sheet.mark(x0, y0, radius)
    elif kind in SHEET_KINDS:
        sheet.press(cell, kind, x0, y0, radius)
    else:
        add_solid(rng, noise, sheet, parts, kind, x0, y0, radius)
    a = np.linspace(0, 6.28, 24, endpoint=False)
    spots = np.concatenate([[[x0, y0, 0]]] + [
        np.stack([x0 + f * radius * np.cos(a), y0 + f * radius * np.sin(a), 0 * a], -1) for f in (0.3, 0.6, 0.85)])
    return {"spots": spots, "mm": 2 * radius, "kind": kind}


def add_cable(rng, noise, parts):
    """A tube from edge to edge of the sheet; returns its centre line and radius."""
    radius, angle = rng.uniform(1.5, 3.0), rng.uniform(0, math.pi)
    s = np.linspace(-1.5, 1.5, 300)
    away = rng.uniform(-0.8, 0.8) * SIZE / 2 * PIXEL
    wave = away + rng.uniform(2, 25) * np.sin(s * rng.uniform(1, 5) + rng.uniform(0, 6))
    along = s * HALF_SHEET
    line = np.stack([along * math.cos(angle) - wave * math.sin(angle),
                     along * math.sin(angle) + wave * math.cos(angle),
                     rng.uniform(5, 12) + radius + 1.5 * np.sin(4 * s)], -1)
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, [0, 0, 1.0])
    up = np.cross(side, ahead)
    a = np.linspace(0, 2 * math.pi, 20, endpoint=False)[None, :, None]
    points = line[:, None] + radius * (np.cos(a) * side[:, None] + np.sin(a) * up[:, None])
    colour = pick(rng, [(0.02, 0.02, 0.02), (0.6, 0.6, 0.58), (0.25, 0.25, 0.25), (0.4, 0.04, 0.03),
                        (0.05, 0.12, 0.4), (0.45, 0.35, 0.05), (0.08, 0.25, 0.08)])
    shade = np.array(colour) * (1 + 0.12 * noise(points[..., 0], points[..., 1], 8)[..., None])
    parts.add(points, grid_faces(300, 20, True), shade.reshape(-1, 3), 0.0, rng.uniform(0.3, 0.7))
    return line, radius


def hidden_share(camera, spots, cables):
    """The share of an item's spots that lie behind a cable."""
    uv, hidden = camera.project(spots), np.zeros(len(spots), bool)
    for line, radius in cables:
        near = np.linalg.norm(uv[:, None] - camera.project(line)[None], axis=2).min(1)
        hidden |= near < radius / PIXEL
    return float(hidden.mean())


# Materials, light and render.


def shader(name):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    bsdf = tree.nodes["Principled BSDF"]
    bump, noise = tree.nodes.new("ShaderNodeBump"), tree.nodes.new("ShaderNodeTexNoise")
    where = tree.nodes.new("ShaderNodeNewGeometry")
    noise.inputs["Scale"].default_value = 2.0
    bump.inputs["Strength"].default_value = 0.25
    bump.inputs["Distance"].default_value = 0.05
    tree.links.new(where.outputs["Position"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Fac"], bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], bsdf.inputs["Normal"])
    return material, tree, bsdf, where


def item_material():
    material, tree, bsdf, _ = shader("items")
    colour, surface = (tree.nodes.new("ShaderNodeAttribute") for _ in range(2))
    colour.attribute_name, surface.attribute_name = "colour", "surface"
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(surface.outputs["Vector"], split.inputs["Vector"])
    tree.links.new(colour.outputs["Color"], bsdf.inputs["Base Color"])
    tree.links.new(split.outputs["X"], bsdf.inputs["Metallic"])
    tree.links.new(split.outputs["Y"], bsdf.inputs["Roughness"])
    return material


def sheet_material(sheet):
    """Colour from the texture, roughness from its alpha; rough dirt is not metallic."""
    image = bpy.data.images.new("sheet", TEXELS, TEXELS, alpha=True, float_buffer=True)
    image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
    image.pixels.foreach_set(np.clip(sheet.texture, 0, 1).ravel())
    material, tree, bsdf, where = shader("sheet")
    texture, place = tree.nodes.new("ShaderNodeTexImage"), tree.nodes.new("ShaderNodeVectorMath")
    texture.image, place.operation = image, "MULTIPLY_ADD"
    place.inputs[1].default_value = (0.5 / HALF_SHEET,) * 3
    place.inputs[2].default_value = (0.5, 0.5, 0.5)
    metal = tree.nodes.new("ShaderNodeMapRange")
    for socket, value in zip(("From Min", "From Max", "To Min", "To Max"), (0.62, 0.75, sheet.metallic, 0.0)):
        metal.inputs[socket].default_value = value
    tree.links.new(where.outputs["Position"], place.inputs[0])
    tree.links.new(place.outputs[0], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], bsdf.inputs["Base Color"])
    tree.links.new(texture.outputs["Alpha"], bsdf.inputs["Roughness"])
    tree.links.new(texture.outputs["Alpha"], metal.inputs["Value"])
    tree.links.new(metal.outputs["Result"], bsdf.inputs["Metallic"])
    return material


def tint(rng, spread=0.12):
    """A light's colour, warm or cool."""
    warm = rng.normal(0, spread)
    return tuple(float(c) for c in np.clip([1 + warm, 1, 1 - warm], 0.5, 1.5))


def light_world(rng):
    """A sky of random strength: two tints blended along a direction and by clouds."""
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 256
    tree, new = world.node_tree, world.node_tree.nodes.new
    where, along, clouds = new("ShaderNodeTexCoord"), new("ShaderNodeVectorMath"), new("ShaderNodeTexNoise")
    total, ramp = new("ShaderNodeMath"), new("ShaderNodeValToRGB")
    along.operation, total.operation = "DOT_PRODUCT", "ADD"
    direction = rng.standard_normal(3)
    along.inputs[1].default_value = tuple(direction / np.linalg.norm(direction) * rng.uniform(0, 0.9))
    clouds.inputs["Scale"].default_value = rng.uniform(0.8, 4)
    low, high = sorted(rng.uniform(0.05, 1.0, 2))
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.25, 0.8
    for element, value in zip(ramp.color_ramp.elements, (low, high)):
        element.color = (*(value * c for c in tint(rng, 0.15)), 1)
    tree.links.new(where.outputs["Generated"], along.inputs[0])
    tree.links.new(where.outputs["Generated"], clouds.inputs["Vector"])
    tree.links.new(along.outputs["Value"], total.inputs[0])
    tree.links.new(clouds.outputs["Fac"], total.inputs[1])
    tree.links.new(total.outputs[0], ramp.inputs["Fac"])
    background = tree.nodes["Background"]
    tree.links.new(ramp.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = float(np.exp(rng.uniform(math.log(0.08), math.log(1.6))))


def add_light(kind, colour, energy, place, **settings):
    """A light at a place (mm) shining at the middle of the sheet; `energy` is its irradiance."""
    data = bpy.data.lights.new(kind, kind)
    distance = float(np.linalg.norm(place))
    data.color = colour
    data.energy = energy if kind == "SUN" else energy * math.pi * distance**2
    for name, value in settings.items():
        setattr(data, name, value)
    light = bpy.data.objects.new(kind, data)
    light.location = tuple(place)
    light.rotation_euler = Matrix.Identity(3).to_euler()
    light.rotation_mode = "QUATERNION"
    from_sheet = light.location.normalized()
    light.rotation_quaternion = from_sheet.to_track_quat("Z", "Y")
    bpy.context.collection.objects.link(light)


def on_sky(rng, low, high):
    """A direction from the sheet at an elevation between the two angles (degrees)."""
    up, around = math.radians(rng.uniform(low, high)), rng.uniform(0, 2 * math.pi)
    return np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])


def light_plate(rng, camera):
    light_world(rng)
    setup = str(rng.choice(["sun", "area", "tubes", "ring", "sky"], p=[0.36, 0.24, 0.14, 0.14, 0.12]))
    if setup == "sun":
        add_light("SUN", tint(rng), rng.uniform(1.5, 6), on_sky(rng, 15, 80), angle=math.radians(rng.uniform(0.5, 5)))
    elif setup == "area":
        for _ in range(int(rng.integers(1, 3))):
            add_light("AREA", tint(rng), rng.uniform(0.8, 3), on_sky(rng, 20, 80) * rng.uniform(700, 1600),
                      shape="DISK", size=rng.uniform(100, 900))
    elif setup == "tubes":
        for _ in range(int(rng.integers(1, 3))):
            add_light("AREA", tint(rng), rng.uniform(0.8, 3), on_sky(rng, 25, 80) * rng.uniform(700, 1600),
                      shape="RECTANGLE", size=rng.uniform(30, 80), size_y=rng.uniform(600, 1500))
    elif setup == "ring":
        wide, energy, colour = rng.uniform(40, 250), rng.uniform(1, 4) / 8, tint(rng)
        for a in np.arange(8) * math.pi / 4:
            place = camera.place + camera.turn @ np.array([wide * math.cos(a), wide * math.sin(a), 0])
            add_light("AREA", colour, energy, place, shape="DISK", size=25.0)


def render(folder):
    """Path-trace the scene; returns linear RGB, top row first."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.filter_size = 1.2
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(Path(folder) / "plate.exr")
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling, cycles.adaptive_threshold = 12, True, 0.05
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 4, 2, 3
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect, cycles.sample_clamp_direct = 6.0, 30.0
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "NONE"
    cycles.denoising_quality = "BALANCED"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(SIZE * SIZE * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(SIZE, SIZE, 4)[::-1, :, :3].astype(np.float64)


# The camera model.


def blur(image, sigma):
    k = np.exp(-0.5 * (np.arange(-4, 5) / sigma) ** 2)
    k /= k.sum()
    for axis in (0, 1):
        pad = [(4, 4) if a == axis else (0, 0) for a in range(image.ndim)]
        wide = np.pad(image, pad, mode="edge")
        n = image.shape[axis]
        image = sum(w * np.take(wide, range(i, i + n), axis) for i, w in enumerate(k))
    return image


def mosaic(image, rng):
    """Bayer mosaic with shot and read noise, and bilinear demosaic."""
    wells = np.exp(rng.uniform(math.log(800), math.log(12000)))
    read = rng.uniform(0.0005, 0.004)
    rows, columns = np.indices(image.shape[:2])
    rows, columns = rows + int(rng.integers(2)), columns + int(rng.integers(2))
    filters = np.where((rows + columns) % 2, 1, np.where(rows % 2, 2, 0))
    raw = np.take_along_axis(image, filters[..., None], 2)[..., 0]
    raw = raw + rng.standard_normal(raw.shape) * np.sqrt(np.maximum(raw, 0) / wells + read**2)
    raw = np.clip(raw, 0, 1)
    out = np.empty_like(image)
    for channel in range(3):
        held = (filters == channel).astype(float)
        out[..., channel] = tent(raw * held) / tent(held)
    return out


def tent(image):
    wide = np.pad(image, 1, mode="reflect")
    wide = wide[:-2] + 2 * wide[1:-1] + wide[2:]
    return wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]


def photograph(rng, linear, dark_sheet):
    """The linear picture as a camera would have saved it."""
    level = np.median(linear @ [0.2126, 0.7152, 0.0722])
    target = rng.uniform(60, 120 if dark_sheet else 200) / 255
    image = linear * (((target + 0.055) / 1.055) ** 2.4 / max(level, 1e-6))
    image = blur(image, rng.uniform(0.4, 1.1))
    image = mosaic(image, rng)
    image = np.clip(image * rng.normal(1, 0.035, 3), 0, 1)
    image = np.where(image < 0.0031308, image * 12.92, 1.055 * np.maximum(image, 1e-9) ** (1 / 2.4) - 0.055)
    image = target + (image - target) * rng.uniform(0.9, 1.15)
    image = image + rng.uniform(0, 0.6) * (image - blur(image, 1.0))
    return Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))


# Plates.


def populate(rng, noise, sheet, parts):
    """Fill the cells; returns the screws and the negatives with their places in the scene."""
    screws, negatives = [], []
    for row in range(CELLS):
        for column in range(CELLS):
            x, y = ((i - (CELLS - 1) / 2) * CELL + rng.uniform(-JITTER, JITTER) for i in (column, row))
            if rng.random() < 0.15:
                sheet.halo(x, y, rng.uniform(2, 6), rng.uniform(0, 0.7), 0.5)
            elif rng.random() < 0.55:
                screws.append(add_screw(rng, noise, sheet, parts, x, y))
            else:
                negatives.append(add_negative(rng, noise, sheet, parts, (row, column), x, y))
    return screws, negatives


def describe(item, camera, cables):
    """An item's pixels and whether it can be seen."""
    u, v = camera.project(item["spots"][0])
    far = float(np.linalg.norm(item["spots"][0] - camera.place))
    d_px = item["mm"] * FOCAL / far
    inside = d_px / 2 <= min(u, v, SIZE - 1 - u, SIZE - 1 - v)
    seen = bool(inside and hidden_share(camera, item["spots"], cables) <= 0.5)
    within = -d_px / 2 < min(u, v) and max(u, v) < SIZE + d_px / 2
    return round(float(u), 2), round(float(v), 2), round(d_px, 2), seen, within


def truth(name, screws, negatives, camera, cables):
    out = {"image": name, "rgb": f"rgb/{name}", "width": SIZE, "height": SIZE, "screws": [], "negatives": []}
    for item in screws:
        u, v, d_px, seen, within = describe(item, camera, cables)
        tags = item["tags"] + ([] if seen else ["hidden"])
        if within:
            out["screws"].append({
                "u": u, "v": v, "head_d_px": d_px, "head_d_mm": round(item["mm"], 2), "type": item["type"],
                "plating": item["plating"], "detectable": seen and item["readable"], "tags": tags})
    for item in negatives:
        u, v, d_px, seen, within = describe(item, camera, cables)
        if within:
            out["negatives"].append({"kind": item["kind"], "u": u, "v": v, "d_mm": round(item["mm"], 2),
                                     "d_px": d_px, "visible": seen})
    return out


def without_contrast(photo, screw):
    """True where the middle of a head differs from a slope by less than 4 grey levels: nothing of its recess is to be seen."""
    u, v, reach = screw["u"], screw["v"], 0.275 * screw["head_d_px"]
    across, down = np.meshgrid(np.arange(photo.shape[1]) - u, np.arange(photo.shape[0]) - v)
    inside = across ** 2 + down ** 2 < reach ** 2
    slope = np.stack([np.ones(inside.sum()), across[inside], down[inside]], 1)
    fitted = slope @ np.linalg.lstsq(slope, photo[inside], rcond=None)[0]
    return float(np.std(photo[inside] - fitted)) < 4.0


def make_plate(seed, picture, record):
    rng = np.random.default_rng(seed)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    noise, camera, parts = Noise(rng), Camera(rng), Parts()
    sheet = Sheet(rng, noise)
    screws, negatives = populate(rng, noise, sheet, parts)
    cables = [add_cable(rng, noise, parts) for _ in range(int(rng.choice(3, p=[0.4, 0.4, 0.2])))]
    parts.build("items", item_material())
    sheet.build()
    camera.build()
    light_plate(rng, camera)
    with tempfile.TemporaryDirectory() as folder:
        linear = render(folder)
    photo = io.BytesIO()
    photograph(rng, linear, sheet.name == "dark").save(photo, "JPEG", quality=int(rng.integers(82, 96)))
    picture.write_bytes(photo.getvalue())
    described = truth(picture.name, screws, negatives, camera, cables)
    gray = np.asarray(Image.open(photo).convert("L").filter(ImageFilter.GaussianBlur(1.0)), float)
    for screw in described["screws"]:
        screw["detectable"] &= not without_contrast(gray, screw)
    partial = record.with_suffix(".part")
    partial.write_text(json.dumps(described))
    os.replace(partial, record)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--plates", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for folder in ("rgb", "truth"):
        (options.out / folder).mkdir(parents=True, exist_ok=True)
    for k in range(1, options.plates + 1):
        picture = options.out / "rgb" / f"plate_{k:04}.jpg"
        record = options.out / "truth" / f"plate_{k:04}.json"
        if not (picture.exists() and record.exists()):
            make_plate(options.seed + k, picture, record)


if __name__ == "__main__":
    main()
