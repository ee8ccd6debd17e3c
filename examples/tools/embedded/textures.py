"""Procedural textures of plausible physical scale: floors, walls, wood, pictures, printed cards.

Every function takes a numpy generator; textures are (SIDE, SIDE, 3) float32 arrays of linear reflectances in 0..1.
"""

import cv2
import numpy as np

SIDE = 128


def colour(rng, low=0.1, high=0.85) -> np.ndarray:
    """A random reflectance; half of the draws are close to grey, as indoor paints are."""
    rgb = rng.uniform(low, high, 3)
    grey = rng.uniform(low, high)
    mix = rng.choice([0.25, 1.0])
    return np.clip(grey + mix * (rgb - grey), 0.03, 0.92).astype(np.float32)


def paint(rng, low=0.45, high=0.88) -> np.ndarray:
    """A light wall or ceiling colour, only slightly tinted."""
    return np.clip(rng.uniform(low, high) + rng.uniform(-0.07, 0.07, 3), 0.05, 0.92).astype(np.float32)


def _field(rng, cells, size=SIDE) -> np.ndarray:
    grid = rng.random((cells, cells)).astype(np.float32)
    return cv2.resize(grid, (size, size), interpolation=cv2.INTER_CUBIC)


def mottled(rng, base, amount=0.12) -> np.ndarray:
    """Plaster, concrete, carpet, matte spray: noise of several scales around one colour."""
    noise = sum(_field(rng, cells) - 0.5 for cells in (5, 17, 60)) / 1.5
    return np.clip(base * (1 + amount * 2 * noise[..., None]), 0.02, 0.95).astype(np.float32)


def smears(rng) -> np.ndarray:
    """(SIDE, SIDE) dust and wiping marks, about 1 on average."""
    return 2 * cv2.GaussianBlur(mottled(rng, np.full(3, 0.5, np.float32), 0.9)[..., 0], (0, 0), 6, sigmaY=1.2)


def planks(rng, base) -> np.ndarray:
    """Eight boards across, grain along the first axis."""
    out = np.empty((SIDE, SIDE, 3), np.float32)
    width = SIDE // 8
    for board in range(8):
        shade = rng.uniform(0.75, 1.15)
        grain = cv2.resize(rng.random((4, width)).astype(np.float32), (width, SIDE), interpolation=cv2.INTER_LINEAR)
        strip = base * shade * (0.88 + 0.24 * grain[..., None])
        seam = int(rng.integers(0, SIDE))
        strip[seam : seam + 2] *= 0.55
        strip[:, :1] *= 0.5
        out[:, board * width : (board + 1) * width] = strip
    return np.clip(out, 0.02, 0.95)


def tiles(rng, base, second=None, cells=4) -> np.ndarray:
    """Square tiles with joints; with a second colour a checkerboard."""
    out = np.empty((SIDE, SIDE, 3), np.float32)
    step = SIDE // cells
    joint = rng.uniform(0.4, 1.3)
    for i in range(cells):
        for j in range(cells):
            tone = second if second is not None and (i + j) % 2 else base
            out[i * step : (i + 1) * step, j * step : (j + 1) * step] = tone * rng.uniform(0.93, 1.05)
    for k in range(cells):
        out[k * step : k * step + 2] = base * joint
        out[:, k * step : k * step + 2] = base * joint
    return np.clip(out, 0.02, 0.95)


def bricks(rng, base) -> np.ndarray:
    out = np.full((SIDE, SIDE, 3), 0.5, np.float32) * rng.uniform(0.6, 1.4)
    height, width = SIDE // 8, SIDE // 4
    for row in range(8):
        for column in range(-1, 4):
            left = column * width + (row % 2) * width // 2
            area = (slice(row * height + 1, (row + 1) * height - 1), slice(max(left + 1, 0), max(left + width - 1, 0)))
            out[area] = base * rng.uniform(0.8, 1.15)
    return np.clip(out, 0.02, 0.95)


def stripes(base, second, count=8) -> np.ndarray:
    out = np.empty((SIDE, SIDE, 3), np.float32)
    out[:] = base
    for k in range(count):
        out[:, k * SIDE // count : k * SIDE // count + SIDE // (2 * count)] = second
    return out


def picture(rng) -> np.ndarray:
    """A poster or painting: gradient and overlapping shapes, sometimes with a horizon that suggests depth."""
    top, bottom = colour(rng), colour(rng)
    ramp = np.linspace(0, 1, SIDE, dtype=np.float32)[:, None, None]
    out = np.ascontiguousarray(np.broadcast_to(top * (1 - ramp) + bottom * ramp, (SIDE, SIDE, 3)))
    for _ in range(rng.integers(2, 9)):
        tone = tuple(float(v) for v in colour(rng))
        centre = tuple(int(v) for v in rng.integers(0, SIDE, 2))
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(out, centre, int(rng.integers(6, 40)), tone, -1)
        elif kind == 1:
            corner = tuple(int(v) for v in rng.integers(0, SIDE, 2))
            cv2.rectangle(out, centre, corner, tone, -1)
        else:
            cv2.fillPoly(out, [rng.integers(0, SIDE, (3, 2)).astype(np.int32)], tone)
    if rng.random() < 0.3:
        cut = int(rng.integers(40, 90))
        out[cut:] = mottled(rng, colour(rng), 0.2)[cut:]
    return np.clip(cv2.GaussianBlur(out, (3, 3), 0), 0.02, 0.95)


def card(rng) -> np.ndarray:
    """What somebody holds against glass: plain paper, a page of lines, a checker, a grid of dots or a poster."""
    kind = rng.integers(6)
    paper = paint(rng, 0.3, 0.9) if rng.random() < 0.6 else colour(rng, 0.15, 0.9)
    if kind == 0:
        return mottled(rng, paper, 0.05)
    if kind == 1:
        out = mottled(rng, paper, 0.03)
        ink = float(rng.uniform(0.03, 0.25))
        for row in range(8, SIDE - 8, int(rng.integers(7, 14))):
            out[row : row + 3, 8 : int(rng.integers(SIDE // 2, SIDE - 6))] = ink
        return out
    if kind == 2:
        return tiles(rng, paper, colour(rng), int(rng.choice([4, 8])))
    if kind == 3:
        out = mottled(rng, paper, 0.03)
        tone = tuple(float(v) for v in colour(rng))
        step = int(rng.integers(14, 26))
        for y in range(step // 2, SIDE, step):
            for x in range(step // 2, SIDE, step):
                cv2.circle(out, (x, y), step // 4, tone, -1)
        return out
    if kind == 4:
        return stripes(paper, colour(rng), int(rng.choice([4, 6, 10])))
    return picture(rng)


def floor(rng) -> tuple[np.ndarray, float]:
    """A floor texture and the side length in metres that one repeat of it covers."""
    kind = rng.integers(4)
    if kind == 0:
        wood = np.array([0.45, 0.29, 0.16], np.float32) * rng.uniform(0.5, 1.5)
        return planks(rng, wood), 1.0
    if kind == 1:
        return tiles(rng, paint(rng, 0.2, 0.8), colour(rng) if rng.random() < 0.4 else None), 1.4
    if kind == 2:
        return mottled(rng, colour(rng, 0.1, 0.6), 0.25), 1.0
    return planks(rng, paint(rng, 0.2, 0.7)), 1.2


def wall(rng) -> tuple[np.ndarray, float]:
    """A wall texture and the side length in metres of one repeat."""
    kind = rng.choice(5, p=[0.55, 0.15, 0.1, 0.1, 0.1])
    base = paint(rng)
    if kind == 0:
        return mottled(rng, base, 0.05), 2.0
    if kind == 1:
        return bricks(rng, np.array([0.5, 0.25, 0.18], np.float32) * rng.uniform(0.6, 1.5)), 0.8
    if kind == 2:
        return stripes(base, np.clip(base * rng.uniform(0.75, 1.15), 0.05, 0.92)), 1.6
    if kind == 3:
        return tiles(rng, base), 0.8
    return mottled(rng, colour(rng, 0.2, 0.8), 0.06), 2.0


def wood(rng) -> np.ndarray:
    tone = np.array([0.5, 0.32, 0.18], np.float32) * rng.uniform(0.35, 1.5)
    grain = cv2.resize(rng.random((6, 40)).astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    return np.clip(tone * (0.85 + 0.3 * grain[..., None]), 0.02, 0.95).astype(np.float32)


def surface(rng) -> np.ndarray:
    """Furniture: wood, paint or cloth."""
    kind = rng.integers(3)
    if kind == 0:
        return wood(rng)
    if kind == 1:
        return mottled(rng, colour(rng), 0.04)
    return mottled(rng, colour(rng), 0.25)
