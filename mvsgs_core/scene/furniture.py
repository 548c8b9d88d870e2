"""Pieces of furniture, each standing at the origin on z = 0; meters. Callers turn and place them."""

from __future__ import annotations

import itertools

import numpy as np

from mvsgs_core.scene import materials, prints
from mvsgs_core.scene.patches import Material, Patch, blob, box, box_faces, cylinder, lathe, quad, surface, transformed

OAK = ((92, 58, 30), (196, 146, 92))
WALNUT = ((48, 28, 18), (128, 84, 52))
PINE = ((158, 108, 62), (228, 188, 132))
TEAK = ((96, 50, 22), (176, 104, 54))


def table(rng: np.random.Generator, length: float = 1.3, width: float = 0.78, height: float = 0.74) -> list[Patch]:
    """A table with a frame and four turned legs, centered."""
    wood = materials.wood(rng, *OAK)
    x, y = length / 2, width / 2
    parts = box((-x, -y, height - 0.035), (x, y, height), wood, skip=(), gloss=0.12)
    parts += box((-x + 0.08, -y + 0.07, height - 0.12), (x - 0.08, y - 0.07, height - 0.035), wood, skip=("top",))
    profile = [(0.03, height - 0.04), (0.04, 0.55), (0.024, 0.5), (0.036, 0.3), (0.022, 0.06), (0.03, 0.0)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            parts.append(lathe((sx * (x - 0.1), sy * (y - 0.09), 0), profile, wood, segments=10))
    return parts


def chair(rng: np.random.Generator, wood_tone: tuple[tuple[int, int, int], tuple[int, int, int]]) -> list[Patch]:
    """A wooden chair with a cushion, facing +y; its back is at -y."""
    wood = materials.wood(rng, *wood_tone)
    parts = box((-0.21, -0.2, 0.42), (0.21, 0.21, 0.455), wood, skip=())
    cloth = materials.fabric(
        rng, prints.random_color(rng, (0.3, 0.8), (0.4, 0.9)), prints.random_color(rng, (0.2, 0.6), (0.5, 1.0))
    )
    parts.append(blob((0, 0, 0.475), (0.19, 0.19, 0.03), cloth, square=0.45, rows=6))
    for x in (-0.19, 0.165):
        parts += box((x, -0.2, 0), (x + 0.028, -0.17, 0.95), wood, skip=())
        parts += box((x, 0.17, 0), (x + 0.028, 0.2, 0.42), wood)
    for z in (0.58, 0.72, 0.86):
        parts += box((-0.165, -0.195, z), (0.165, -0.178, z + rng.uniform(0.05, 0.085)), wood, skip=())
    return parts


def book(rng: np.random.Generator, low: tuple[float, float, float], size: tuple[float, float, float]) -> list[Patch]:
    """A standing book whose spine looks to -y: size (thickness, depth, height)."""
    high = (low[0] + size[0], low[1] + size[1], low[2] + size[2])
    faces = box_faces(low, high)
    pages = materials.wood(rng, (190, 176, 140), (238, 230, 206))
    cloth = materials.marbled(rng, [0.7 * (c := prints.random_color(rng, (0.1, 0.7), (0.2, 0.8))), c])
    return [
        surface(faces["front"], prints.spine(rng)),
        surface(faces["top"], pages),
        surface(faces["left"], cloth),
        surface(faces["right"], cloth),
    ]


def book_row(rng: np.random.Generator, x0: float, x1: float, z: float, room: float) -> list[Patch]:
    """Books side by side from x0 to x1 on a board at z, at most `room` high, spines at about y = 0, with gaps."""
    parts: list[Patch] = []
    x = x0
    while x < x1 - 0.05:
        if rng.random() < 0.07:
            x += rng.uniform(0.03, 0.1)
            continue
        thick, tall = rng.uniform(0.014, 0.052), min(room - 0.02, rng.uniform(0.17, 0.31))
        if x + thick > x1:
            break
        parts += book(rng, (x, rng.uniform(0.0, 0.035), z), (thick, rng.uniform(0.13, 0.2), tall))
        x += thick + 0.0015
    return parts


def book_stack(rng: np.random.Generator, count: int) -> list[Patch]:
    """Books lying on each other, centered."""
    parts: list[Patch] = []
    z = 0.0
    for _ in range(count):
        w, d, t = rng.uniform(0.17, 0.26), rng.uniform(0.13, 0.19), rng.uniform(0.015, 0.045)
        faces = box_faces((-w / 2, -d / 2, 0), (w / 2, d / 2, t))
        pages = materials.wood(rng, (190, 176, 140), (238, 230, 206))
        lying = prints.spine(rng)
        sides = [
            surface(faces["top"], prints.cover(rng)),
            surface(faces["left"], pages),
            surface(faces["right"], pages),
        ]
        sides.append(surface(faces["back"], pages))
        front = surface(faces["front"].transpose(1, 0, 2)[::-1], lying)
        parts += transformed([*sides, front], rng.normal(0, 0.3), (0, 0, z))
        z += t
    return parts


def bookshelf(rng: np.random.Generator, width: float, height: float, boards: int) -> list[Patch]:
    """A shelf against y = 0.32, its front at y = 0, from x = 0 to `width`."""
    wood = materials.wood(rng, *WALNUT)
    parts = box((0, 0.0, 0), (0.025, 0.32, height), wood, skip=("back",))
    parts += box((width - 0.025, 0.0, 0), (width, 0.32, height), wood, skip=("back",))
    parts.append(surface(quad((0, 0.315, height), (width, 0, 0), (0, 0, -height)), wood))
    parts += box((0, 0.0, height - 0.025), (width, 0.32, height), wood, skip=())
    pitch = (height - 0.1) / boards
    for k in range(boards):
        z = 0.07 + k * pitch
        parts += box((0.025, 0.005, z - 0.022), (width - 0.025, 0.315, z), wood, skip=("left", "right", "back"))
        split = rng.uniform(0.35, 0.7) * width
        parts += transformed(book_row(rng, 0.03, split, z, pitch - 0.03), 0, (0, 0.04, 0))
        if k % 2 == 0:
            parts += transformed(vase(rng, rng.uniform(0.12, 0.22)), 0, (split + 0.12, 0.15, z))
            parts += transformed(
                book_stack(rng, int(rng.integers(2, 5))), rng.uniform(-0.4, 0.4), (width - 0.2, 0.15, z)
            )
        else:
            parts += transformed(book_row(rng, split + 0.16, width - 0.03, z, pitch - 0.03), 0, (0, 0.05, 0))
            parts += transformed(framed(rng, 0.13, 0.17, "still_life"), 0.0, (split + 0.08, 0.12, z + 0.09))
    return parts


def vase(rng: np.random.Generator, height: float) -> list[Patch]:
    """A glazed vase."""
    z = np.linspace(1.0, 0.0, 9)
    bulge = rng.uniform(0.25, 0.42)
    radius = height * (0.12 + bulge * np.sin(np.pi * (z * 0.85 + 0.12)) ** 2 * (1.1 - 0.5 * z))
    palette = [prints.random_color(rng, (0.2, 0.9), (0.15, 0.95)) for _ in range(4)]
    glaze = materials.marbled(rng, palette, grain=14)
    return [lathe((0, 0, 0), list(zip(radius, z * height)), glaze, segments=18, gloss=0.5, two_sided=True)]


def framed(rng: np.random.Generator, width: float, height: float, kind: str) -> list[Patch]:
    """A painting in a frame, centered, hanging at y = 0 and looking to -y."""
    w, h, edge, deep = width / 2, height / 2, 0.035 * (1 if width > 0.3 else 0.4), 0.025
    wood = materials.wood(rng, *(WALNUT if rng.random() < 0.5 else PINE))
    picture = surface(quad((-w, -0.6 * deep, h), (width, 0, 0), (0, 0, -height)), prints.painting(rng, kind))
    parts = [picture]
    for low, high in (
        ((-w - edge, -deep, h), (w + edge, 0, h + edge)),
        ((-w - edge, -deep, -h - edge), (w + edge, 0, -h)),
        ((-w - edge, -deep, -h), (-w, 0, h)),
        ((w, -deep, -h), (w + edge, 0, h)),
    ):
        parts += box(low, high, wood, skip=("back",))
    return parts


def sofa(rng: np.random.Generator, length: float = 1.9) -> list[Patch]:
    """A sofa with pillows and a blanket, its back at y = 0 and its seat to -y, centered in x."""
    color = np.array([104.0, 116.0, 128.0])
    cloth = materials.fabric(rng, color)
    x = length / 2
    parts = box((-x, -0.85, 0.1), (x, 0, 0.36), cloth, skip=("back", "bottom"))
    parts.append(blob((0, -0.12, 0.6), (x, 0.13, 0.27), cloth, square=0.35, rows=12, columns=28))
    for side in (-1, 1):
        parts.append(blob((side * (x - 0.09), -0.43, 0.42), (0.12, 0.43, 0.2), cloth, square=0.4))
        parts.append(blob((side * (x - 0.2) / 2, -0.5, 0.42), ((x - 0.2) / 2, 0.33, 0.09), cloth, square=0.35))
    for at, turn in ((-0.62, 0.3), (-0.3, -0.2), (0.55, 0.15)):
        tones = [prints.random_color(rng, (0.4, 0.9), (0.4, 0.95)) for _ in range(5)]
        cover = materials.rug(rng, tones) if at < 0 else materials.fabric(rng, tones[0], tones[1])
        pillow = blob((0, 0, 0), (0.21, 0.08, 0.2), cover, square=0.6, rows=12, columns=20)
        parts += transformed([pillow], turn, (at * length / 1.9, -0.34, 0.66))
    tones = [prints.random_color(rng, (0.2, 0.7), (0.5, 0.95)) for _ in range(4)]
    parts += transformed([blanket(rng, 0.55, 0.75, materials.rug(rng, tones))], 0, (0.2, -0.5, 0.535))
    return parts


def blanket(rng: np.random.Generator, width: float, depth: float, cloth: Material) -> Patch:
    """A cloth lying with folds, centered."""
    v, u = np.meshgrid(np.linspace(1, -1, 19), np.linspace(-1, 1, 25), indexing="ij")
    fold = 0.012 * np.sin(7 * u + 3 * v + 2 * np.sin(3 * v)) + 0.008 * np.sin(11 * v - 4 * u)
    drop = -0.2 * np.clip(-v - 0.75, 0, 1)
    points = np.stack([u * width / 2 + 0.02 * np.sin(5 * v), v * depth / 2, 0.02 + fold + drop], axis=-1)
    return surface(points, cloth, two_sided=True)


def plant(rng: np.random.Generator, height: float, leaves: int) -> list[Patch]:
    """A potted plant of arching leaves."""
    pot = 0.28 * height
    clay = materials.marbled(rng, [(120, 62, 40), (176, 104, 72), (150, 84, 58)], grain=10)
    parts = [
        lathe((0, 0, 0), [(0.16 * height, pot), (0.17 * height, 0.85 * pot), (0.11 * height, 0)], clay, segments=18),
        lathe(
            (0, 0, 0),
            [(1e-4, 0.92 * pot), (0.155 * height, 0.92 * pot)],
            materials.marbled(rng, [(38, 28, 20), (84, 64, 46)]),
        ),
    ]
    for k in range(leaves):
        turn, rise, reach = k * 2.39996 + rng.normal(0, 0.3), rng.uniform(0.35, 0.75), rng.uniform(0.2, 0.48)
        t = np.linspace(0, 1, 7)[:, None]
        side = np.linspace(-1, 1, 3)[None]
        wide = 0.085 * height * np.sin(np.pi * np.clip(t * 0.92 + 0.06, 0, 1)) ** 0.8
        out = reach * height * t**1.2
        up = pot + height * (rise * t - 0.42 * rise * t**3.2)
        points = np.stack([out + 0 * side, wide * side, up + 0.25 * wide * np.abs(side)], axis=-1)
        green = rng.uniform(0.7, 1.25) * np.array([66.0, 118.0, 52.0]) + rng.normal(0, 10, 3)
        leaf = materials.marbled(rng, [0.55 * green, green, 1.3 * green], grain=16)
        parts += transformed([surface(points, leaf, two_sided=True)], turn, (0, 0, 0))
    return parts


def lamp(rng: np.random.Generator, height: float, shade: float) -> list[Patch]:
    """A standing lamp; `shade` is the radius of its shade."""
    wood, linen = materials.wood(rng, *TEAK), materials.fabric(rng, (236, 214, 170))
    top, low = height, height - 1.3 * shade
    foot = [(0.012, low + 0.1), (0.012, 0.06), (0.1 * height**0.5, 0.02), (0.11 * height**0.5, 0.0)]
    return [
        lathe((0, 0, 0), foot, wood, segments=12),
        lathe((0, 0, 0), [(0.62 * shade, top), (shade, low)], linen, segments=24, two_sided=True),
    ]


def sideboard(rng: np.random.Generator, length: float = 1.7, height: float = 0.8, depth: float = 0.42) -> list[Patch]:
    """A cabinet with doors and drawers, its back at y = 0 and its front at -depth, centered in x."""
    wood, front = materials.wood(rng, *TEAK), materials.wood(rng, *OAK)
    brass = materials.marbled(rng, [(120, 92, 40), (214, 178, 96)])
    x = length / 2
    parts = box((-x, -depth, 0.12), (x, 0, height), wood, skip=("back",), gloss=0.1)
    for sx in (-1, 1):
        parts += box((sx * (x - 0.08) - 0.025, -depth + 0.04, 0), (sx * (x - 0.08) + 0.025, -depth + 0.09, 0.12), wood)
    columns = np.linspace(-x + 0.03, x - 0.03, 4)
    for k in range(3):
        rows = np.linspace(0.15, height - 0.04, 4 if k == 1 else 2)
        for low, high in itertools.pairwise(rows):
            a, b = columns[k] + 0.008, columns[k + 1] - 0.008
            parts += box((a, -depth - 0.018, low + 0.008), (b, -depth, high - 0.008), front, skip=("back",))
            knob = (0.5 * (a + b) if k == 1 else (b - 0.05 if k == 0 else a + 0.05), -depth - 0.03, 0.5 * (low + high))
            parts.append(blob(knob, (0.014, 0.014, 0.014), brass, rows=6, columns=10))
    return parts


def bowl_of_fruit(rng: np.random.Generator) -> list[Patch]:
    """A bowl with apples, oranges and pears."""
    glaze = materials.marbled(rng, [(40, 70, 120), (200, 210, 214), (70, 110, 160)], grain=18)
    profile = [(0.16, 0.1), (0.14, 0.05), (0.09, 0.02), (0.06, 0.0)]
    parts = [lathe((0, 0, 0), profile, glaze, segments=22, two_sided=True, gloss=0.5)]
    for k in range(9):
        turn, reach = k * 2.4, 0.0 if k == 8 else rng.uniform(0.05, 0.09)
        base = np.array(((190, 44, 36), (226, 138, 40), (156, 172, 58))[k % 3], dtype=float)
        peel = materials.marbled(rng, [0.6 * base, base, np.minimum(255, base * 1.25 + 20)], grain=22)
        size = rng.uniform(0.032, 0.042)
        at = (reach * np.cos(turn), reach * np.sin(turn), 0.085 + (0.06 if k == 8 else 0.0))
        parts.append(blob(at, (size, size, size * (1.25 if k % 3 == 2 else 0.95)), peel, rows=8, columns=12))
    return parts


def mug(rng: np.random.Generator) -> list[Patch]:
    """A mug."""
    palette = [prints.random_color(rng, (0.2, 0.9), (0.3, 1.0)) for _ in range(3)]
    return cylinder((0, 0, 0), 0.04, 0.095, materials.marbled(rng, palette, grain=24), gloss=0.4)


def crate(rng: np.random.Generator, size: float) -> list[Patch]:
    """A wooden box with things in it, centered."""
    wood = materials.wood(rng, *PINE)
    s = size / 2
    parts: list[Patch] = []
    for z in np.linspace(0, 0.62 * size, 4)[:-1]:
        parts += box((-s, -s, z + 0.01), (s, s, z + 0.185 * size), wood, skip=())
    for _ in range(7):
        tones = [prints.random_color(rng, (0.3, 0.9), (0.3, 0.95)) for _ in range(3)]
        at = (*rng.uniform(-0.6 * s, 0.6 * s, 2), 0.62 * size)
        parts.append(blob(at, rng.uniform(0.04, 0.09, 3), materials.marbled(rng, tones, grain=14), rows=8, columns=12))
    return parts
