"""The furnished room: walls of different make, furniture along them, a table in the middle, light from a window."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.scene import furniture, materials, prints
from mvsgs_core.scene.lighting import Lighting, RectLight
from mvsgs_core.scene.patches import Material, Patch, blob, box, cylinder, lathe, quad, surface, transformed

WIDTH, LENGTH, HEIGHT = 5.2, 4.4, 2.6  # meters: x, y, z
WINDOW = ((1.25, 0.95), (3.15, 2.2))  # (y, z) corners on the east wall
WALLS = ("west", "north", "east", "south")  # in the order in which `plain_walls` takes them

LIGHTING = Lighting(
    texel=0.065,
    rects=(
        RectLight((WIDTH - 0.16, WINDOW[0][0], WINDOW[0][1]), (0, 0, 1.25), (0, 1.9, 0), (13.5, 14.2, 15.0)),
        RectLight((2.45, 2.05, 1.88), (0, 0.3, 0), (0.3, 0, 0), (11.0, 8.8, 6.2)),
        RectLight((0.25, 4.0, 1.62), (0, 0.25, 0), (0.25, 0, 0), (8.0, 6.0, 3.6)),
    ),
    ambient=(0.2, 0.2, 0.2),
    gloss_at=(WIDTH - 0.1, 2.2, 1.6),
)


def build(seed: int, plain_walls: int = 0) -> list[Patch]:
    """Patches of the room. `plain_walls`: how many walls (0 to 4) are bare, painted in one color."""
    # A stream of its own for every part: what is left out of one changes nothing in the others.
    walls, shell, window, west, north, south, east, middle = np.random.default_rng([seed, 1]).spawn(8)
    bare = set(WALLS[:plain_walls])
    return [
        *_walls(walls, bare),
        *_shell(shell),
        *_window(window),
        *_west(west, "west" in bare),
        *_north(north, "north" in bare),
        *_south(south, "south" in bare),
        *_east(east),
        *_middle(middle),
    ]


def against(wall: str, along: float, parts: list[Patch], z: float = 0.0) -> list[Patch]:
    """Parts whose back is at y = 0 set against a wall, `along` meters from the room's x = 0 or y = 0."""
    yaw, shift = {
        "north": (0.0, (along, LENGTH, z)),
        "south": (np.pi, (along, 0.0, z)),
        "west": (np.pi / 2, (0.0, along, z)),
        "east": (-np.pi / 2, (WIDTH, along, z)),
    }[wall]
    return transformed(parts, yaw, shift)


def _walls(rng: np.random.Generator, bare: set[str]) -> list[Patch]:
    leaves = [(92, 122, 84), (146, 158, 100), (178, 120, 84), (84, 112, 124), (190, 164, 108), (140, 84, 78)]
    coat: dict[str, Material] = {
        "west": materials.wallpaper(rng, (206, 198, 176), leaves),
        "north": materials.plaster(rng, (164, 182, 182), 22),
        "east": materials.masonry(rng, [(112, 54, 40), (176, 96, 70), (150, 84, 66), (196, 130, 98)], (178, 168, 152)),
        "south": materials.plaster(rng, (206, 180, 138), 22),
    }
    w, d, h = WIDTH, LENGTH, HEIGHT
    quads = {
        "west": quad((0, 0, h), (0, d, 0), (0, 0, -h)),
        "north": quad((0, d, h), (w, 0, 0), (0, 0, -h)),
        "east": quad((w, d, h), (0, -d, 0), (0, 0, -h)),
        "south": quad((w, 0, h), (-w, 0, 0), (0, 0, -h)),
    }
    return [surface(q, materials.plain((206, 202, 192)) if n in bare else coat[n]) for n, q in quads.items()]


def _shell(rng: np.random.Generator) -> list[Patch]:
    w, d, h = WIDTH, LENGTH, HEIGHT
    boards = materials.planks(rng, (84, 50, 28), (190, 136, 84))
    parts = [surface(quad((0, d, 0), (w, 0, 0), (0, -d, 0)), boards, gloss=0.2)]
    ceiling = materials.plaster(rng, (216, 212, 202), 18, density=130)
    parts.append(surface(quad((0, 0, h), (w, 0, 0), (0, d, 0)), ceiling))
    for x in (0.7, 1.95, 3.2, 4.45):
        beam = materials.wood(rng, *furniture.WALNUT, density=200)
        parts += box((x, 0, h - 0.15), (x + 0.16, d, h), beam, skip=("top", "front", "back"))
    skirting = materials.wood(rng, *furniture.PINE)
    parts += box((0, d - 0.018, 0), (w, d, 0.09), skirting, skip=("bottom", "back", "left", "right"))
    parts += box((0, 0, 0), (0.018, d, 0.09), skirting, skip=("bottom", "left", "front", "back"))
    parts += box((w - 0.018, 0, 0), (w, d, 0.09), skirting, skip=("bottom", "right", "front", "back"))
    parts += box((0, 0, 0), (3.45, 0.018, 0.09), skirting, skip=("bottom", "front", "left"))
    return parts


def _window(rng: np.random.Generator) -> list[Patch]:
    (y0, z0), (y1, z1) = WINDOW
    x, wood = WIDTH, materials.wood(rng, (150, 140, 124), (236, 232, 222))
    garden = cv2.GaussianBlur(prints.painting(rng, "landscape", density=240)(z1 - z0, y1 - y0), (0, 0), 2.5)
    pane = Patch(quad((x - 0.03, y1, z1), (0, y0 - y1, 0), (0, 0, z0 - z1)), garden, emission=1.5)
    parts = [pane]
    for a, b in ((y0 - 0.07, y0), (y1, y1 + 0.07), (0.5 * (y0 + y1) - 0.025, 0.5 * (y0 + y1) + 0.025)):
        parts += box((x - 0.08, a, z0), (x, b, z1), wood, skip=("right",))
    parts += box((x - 0.08, y0 - 0.07, z1), (x, y1 + 0.07, z1 + 0.08), wood, skip=("right",))
    parts += box((x - 0.07, y0, 1.74), (x, y1, 1.78), wood, skip=("right",))
    parts += box((x - 0.24, y0 - 0.1, z0 - 0.04), (x, y1 + 0.1, z0), wood, skip=("right",))
    parts += box(
        (x - 0.17, y0 - 0.4, z1 + 0.16), (x - 0.15, y1 + 0.4, z1 + 0.18), materials.wood(rng, *furniture.WALNUT)
    )
    for middle, phase in ((y0 - 0.17, 0.0), (y1 + 0.17, 2.0)):
        u = np.linspace(-1, 1, 41)
        wave = 0.035 * np.sin(13 * u + phase) + 0.012 * np.sin(29 * u + 2 * phase)
        top = np.stack([x - 0.14 + wave, middle - 0.22 * u, np.full_like(u, z1 + 0.16)], axis=-1)
        low = np.stack([x - 0.14 + 1.3 * wave, middle - 0.24 * u, np.full_like(u, 0.12)], axis=-1)
        cloth = materials.wallpaper(rng, (196, 182, 150), [(150, 70, 52), (92, 104, 66), (54, 82, 104), (206, 150, 70)])
        parts.append(surface(np.stack([top, low]), cloth, two_sided=True))
    return parts


def _west(rng: np.random.Generator, bare: bool) -> list[Patch]:
    parts = against("west", 2.15, transformed(furniture.sofa(rng), 0, (0, -0.04, 0)))
    parts += transformed(furniture.lamp(rng, 1.75, 0.2), 0, (0.38, 4.05, 0))
    parts += transformed(furniture.plant(rng, 1.05, 17), 0, (0.42, 0.5, 0))
    parts += transformed(furniture.book_stack(rng, 6), 0.4, (0.45, 3.45, 0))
    if not bare:
        parts += against("west", 2.3, furniture.framed(rng, 1.15, 0.72, "landscape"), 1.5)
        parts += against("west", 3.45, furniture.framed(rng, 0.42, 0.56, "abstract"), 1.62)
        parts += against("west", 1.15, furniture.framed(rng, 0.36, 0.36, "still_life"), 1.75)
        parts += against("west", 1.05, furniture.framed(rng, 0.5, 0.34, "landscape"), 1.3)
    return parts


def _north(rng: np.random.Generator, bare: bool) -> list[Patch]:
    shelf = transformed(furniture.bookshelf(rng, 1.75, 2.05, 6), 0, (0, -0.335, 0))
    parts = against("north", 0.75, shelf)
    parts += transformed(furniture.vase(rng, 0.34), 0, (1.1, 4.2, 2.05))
    parts += transformed(furniture.crate(rng, 0.26), 0.2, (1.8, 4.22, 2.05))
    bench = materials.wood(rng, *furniture.TEAK)
    parts += box((2.85, 4.02, 0.42), (4.35, 4.38, 0.46), bench, skip=())
    for x in (2.9, 3.57, 4.25):
        parts += box((x, 4.05, 0), (x + 0.05, 4.36, 0.42), bench)
    parts += transformed(furniture.crate(rng, 0.3), 0.1, (3.15, 4.2, 0.0))
    parts += transformed(furniture.crate(rng, 0.34), -0.15, (3.95, 4.18, 0.0))
    parts += transformed(furniture.book_stack(rng, 5), 0.2, (3.1, 4.2, 0.46))
    parts += transformed(furniture.plant(rng, 0.5, 13), 0, (3.6, 4.2, 0.46))
    parts += transformed(furniture.mug(rng), 0, (3.38, 4.14, 0.46))
    parts += transformed(furniture.vase(rng, 0.27), 0, (4.1, 4.2, 0.46))
    parts += transformed(furniture.plant(rng, 1.35, 19), 0.5, (4.8, 4.0, 0))
    if not bare:
        parts += against("north", 3.05, furniture.framed(rng, 0.5, 0.66, "abstract"), 1.55)
        parts += against("north", 3.78, furniture.framed(rng, 0.62, 0.42, "landscape"), 1.75)
        parts += against("north", 3.72, furniture.framed(rng, 0.34, 0.26, "still_life"), 1.3)
        parts += against("north", 4.42, furniture.framed(rng, 0.38, 0.5, "still_life"), 1.5)
        parts += against("north", 2.67, furniture.framed(rng, 0.16, 0.22, "abstract"), 1.95)
    return parts


def _south(rng: np.random.Generator, bare: bool) -> list[Patch]:
    parts = against("south", 2.0, furniture.sideboard(rng))
    parts += transformed(furniture.lamp(rng, 0.5, 0.13), 0, (1.4, 0.22, 0.8))
    parts += transformed(furniture.vase(rng, 0.3), 0, (2.6, 0.2, 0.8))
    parts += against("south", 2.05, transformed(furniture.framed(rng, 0.2, 0.26, "still_life"), 0, (0, -0.12, 0)), 0.96)
    parts += against("south", 1.75, transformed(furniture.framed(rng, 0.18, 0.14, "landscape"), 0, (0, -0.2, 0)), 0.89)
    parts += transformed(furniture.book_stack(rng, 4), 0.15, (2.33, 0.24, 0.8))
    door, frame = materials.wood(rng, *furniture.TEAK), materials.wood(rng, (160, 150, 132), (232, 226, 212))
    parts += box((3.55, 0, 0), (4.45, 0.03, 2.05), door, skip=("front",))
    for x in (3.65, 4.05):
        for z, tall in ((0.15, 0.75), (1.05, 0.85)):
            parts += box((x, 0.03, z), (x + 0.3, 0.045, z + tall), door, skip=("front",))
    for low, high in (((3.47, 0), (3.55, 2.13)), ((4.45, 0), (4.53, 2.13)), ((3.55, 2.05), (4.45, 2.13))):
        parts += box((low[0], 0, low[1]), (high[0], 0.05, high[1]), frame, skip=("front",))
    brass = materials.marbled(rng, [(110, 84, 40), (220, 186, 110)])
    parts.append(blob((3.63, 0.08, 1.02), (0.03, 0.03, 0.03), brass))
    u, v = np.linspace(1, -1, 25), np.linspace(0, 1, 13)[:, None]
    fold = 0.05 + (0.3 + 0.7 * v) * (0.022 * np.sin(9 * u + 2 * v) + 0.012 * np.sin(21 * u))
    shawl = np.stack([3.12 + (0.17 + 0.04 * v) * u, fold, 1.72 - 0.95 * v + 0.03 * np.sin(4 * u)], axis=-1)
    parts.append(surface(shawl, materials.fabric(rng, (70, 84, 120), (170, 120, 70)), two_sided=True))
    parts += box((2.9, 0, 1.72), (3.34, 0.07, 1.78), frame, skip=("front",))
    parts += transformed(furniture.crate(rng, 0.36), 0.3, (4.85, 0.35, 0))
    if not bare:
        parts += against("south", 2.0, furniture.framed(rng, 0.95, 0.68, "abstract"), 1.7)
        parts += against("south", 1.1, furniture.framed(rng, 0.4, 0.54, "landscape"), 1.62)
        parts += against("south", 0.62, furniture.framed(rng, 0.3, 0.24, "still_life"), 1.75)
        parts += against("south", 4.86, furniture.framed(rng, 0.34, 0.46, "landscape"), 1.5)
    return parts


def _east(rng: np.random.Generator) -> list[Patch]:
    iron = materials.marbled(rng, [(150, 146, 138), (222, 220, 212)], grain=8)
    parts: list[Patch] = []
    for y in np.arange(1.45, 2.95, 0.09):
        parts += box((WIDTH - 0.14, y, 0.12), (WIDTH - 0.05, y + 0.065, 0.78), iron, skip=("right",))
    for y, height in ((1.5, 0.3), (2.2, 0.22), (2.9, 0.34)):
        parts += transformed(furniture.plant(rng, height, 11), y, (WIDTH - 0.14, y, WINDOW[0][1]))
    parts += transformed(furniture.chair(rng, furniture.PINE), np.pi / 2 + 0.3, (4.75, 3.3, 0))
    parts += transformed(furniture.book_stack(rng, 3), 0.5, (4.75, 3.3, 0.5))
    return parts


def _middle(rng: np.random.Generator) -> list[Patch]:
    tones = [(96, 38, 34), (200, 172, 120), (48, 62, 88), (168, 96, 58), (206, 194, 168), (94, 104, 82)]
    parts = box((1.35, 1.35, 0), (3.85, 3.05, 0.012), materials.rug(rng, tones))
    parts += transformed(furniture.table(rng), 0.12, (2.6, 2.2, 0.012))
    for at, turn in (
        ((2.15, 1.5), 0.15),
        ((3.0, 1.6), -0.3),
        ((2.3, 2.9), 3.3),
        ((3.2, 2.85), 2.7),
        ((3.6, 2.15), 1.5),
    ):
        tone = furniture.OAK if turn > 0 else furniture.WALNUT
        parts += transformed(furniture.chair(rng, tone), turn, (*at, 0.012))
    top = 0.752
    parts += transformed(furniture.bowl_of_fruit(rng), 0, (2.62, 2.22, top))
    parts += transformed(furniture.book_stack(rng, 4), 0.5, (2.2, 2.3, top))
    parts += transformed(furniture.vase(rng, 0.26), 0, (2.95, 2.4, top))
    parts += transformed(furniture.mug(rng), 0, (2.4, 2.0, top))
    parts += transformed(furniture.mug(rng), 1, (2.9, 2.05, top))
    parts += transformed(furniture.plant(rng, 0.36, 12), 0, (3.1, 2.12, top))
    sheet = box((-0.15, -0.2, 0), (0.15, 0.2, 0.004), prints.paper(rng))
    parts += transformed(sheet, -0.5, (2.66, 1.97, top))
    parts += cylinder((2.6, 2.2, 1.98), 0.008, HEIGHT - 1.98, materials.plain((40, 36, 32)), segments=6)
    shade = materials.fabric(rng, (226, 196, 140))
    parts.append(lathe((2.6, 2.2, 0), [(0.09, 2.12), (0.27, 1.93)], shade, segments=28, two_sided=True))
    return parts
