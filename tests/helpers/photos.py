"""Photo-like pictures, known motions of them, and raw trees of such frames, for the registration and prepare tests."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.prepare.matching import Frame
from gift_peft.prepare.settings import RegistrationSettings

SETTINGS = RegistrationSettings()


def scene(seed: int, size=(480, 640)) -> np.ndarray:
    """(H, W, 3) uint8: soft shading with shapes and patches of texture on it, as a tabletop has them."""
    rng = np.random.default_rng(seed)
    height, width = size
    coarse = rng.uniform(60, 190, (4, 5, 3)).astype(np.float32)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        centre = int(rng.integers(0, width)), int(rng.integers(0, height))
        axes = int(rng.integers(6, 60)), int(rng.integers(6, 60))
        colour = rng.uniform(10, 245, 3).tolist()
        if rng.random() < 0.5:
            cv2.ellipse(picture, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            corner = centre[0] + axes[0], centre[1] + axes[1]
            cv2.rectangle(picture, centre, corner, colour, -1)
    texture = cv2.resize(rng.normal(0, 10, (height // 3, width // 3, 3)).astype(np.float32), (width, height))
    return np.clip(cv2.GaussianBlur(picture + texture, (0, 0), 0.8), 0, 255).astype(np.uint8)


def target(seed: int, size=(480, 640)) -> np.ndarray:
    """(H, W) bool: an ellipse or a box somewhere, up to a third of each side."""
    rng = np.random.default_rng(seed)
    height, width = size
    mask = np.zeros(size, np.uint8)
    high, wide = int(rng.uniform(0.12, 0.34) * height), int(rng.uniform(0.12, 0.34) * width)
    top, left = int(rng.integers(10, height - high - 10)), int(rng.integers(10, width - wide - 10))
    if rng.random() < 0.5:
        mask[top : top + high, left : left + wide] = 1
    else:
        cv2.ellipse(mask, (left + wide // 2, top + high // 2), (wide // 2, high // 2), 0, 0, 360, 1, -1)
    return mask > 0


def motion(rng, size, translation=15.0, degrees=2.0, perspective=1e-5) -> np.ndarray:
    """(3, 3): fixed to moving pixels; a shift up to `translation`, a turn about the middle, a slight perspective."""
    height, width = size
    angle, heading = np.deg2rad(rng.uniform(-degrees, degrees)), rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    middle = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1.0]])
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    bend = np.eye(3)
    bend[2, :2] = rng.uniform(-perspective, perspective, 2)
    shift = np.eye(3)
    shift[:2, 2] = rng.uniform(0, translation) * np.array([np.cos(heading), np.sin(heading)])
    return shift @ middle @ turn @ bend @ np.linalg.inv(middle)


def moved(picture: np.ndarray, mask: np.ndarray, matrix: np.ndarray, rng, noise=4.0):
    """The frame and mask that a camera moved by `matrix` sees, in another light, with another content and noise."""
    height, width = mask.shape
    # Not as the code under test warps: bicubic, and sometimes with a black border.
    border = cv2.BORDER_REFLECT if rng.random() < 0.5 else cv2.BORDER_CONSTANT
    frame = cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=border)
    there = cv2.warpPerspective(mask.astype(np.uint8), matrix, (width, height), flags=cv2.INTER_NEAREST) > 0
    frame = frame * rng.uniform(0.75, 1.25) + rng.uniform(-15, 15)
    return with_content(frame, there, rng, noise), there


def with_content(frame: np.ndarray, mask: np.ndarray, rng, noise=4.0) -> np.ndarray:
    """The frame with something else seen in its target, and noise."""
    content = scene(int(rng.integers(1 << 30)), mask.shape)
    frame = np.where(mask[..., None], content, frame).astype(np.float64)
    return np.clip(np.round(frame + rng.normal(0, noise, frame.shape)), 0, 255).astype(np.uint8)


def write_capture(folder: Path, frames, masks, reference=None) -> Path:
    """A group of the raw tree: `<index>.png` and `masks/<index>.png`."""
    (folder / "masks").mkdir(parents=True)
    for index, (frame, mask) in enumerate(zip(frames, masks, strict=True)):
        Image.fromarray(frame).save(folder / f"{index}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "masks" / f"{index}.png")
    if reference is not None:
        Image.fromarray(reference).save(folder / "reference.png")
    return folder


def capture(folder: Path, seed: int, count=3, size=(240, 320), reference=False, motions=()) -> Path:
    """A group of one scene; `motions` moves its first frames."""
    rng = np.random.default_rng(seed)
    picture, mask = scene(seed, size), target(seed, size)
    frames, masks = [], []
    for index in range(count):
        if index < len(motions):
            frame, there = moved(picture, mask, motions[index], rng, noise=1.0)
        else:
            frame, there = with_content(picture, mask, rng, noise=1.0), mask
        frames.append(frame)
        masks.append(there)
    treated = None
    if reference:
        treated = picture.copy()
        treated[mask] = 150
    return write_capture(folder, frames, masks, treated)


def entry(report, group_id):
    return next(group for group in report["groups"] if group["group_id"] == group_id)


def statuses(report, group_id):
    return [frame["status"] for frame in entry(report, group_id)["frames"]]


def frames(seed, size=(360, 480)):
    picture, mask = scene(seed, size), target(seed, size)
    return picture, mask, Frame(picture, mask, SETTINGS)


def through(matrix, points):
    """Straight-line oracle of a homography."""
    return np.array(
        [[(m := matrix @ np.array([x, y, 1.0]))[0] / m[2], m[1] / m[2]] for x, y in np.asarray(points, np.float64)]
    )
