"""A clip or a camera, frame by frame (`gift-peft predict --video`): photo, base and adapted side by side.

With a mask it also measures flicker inside the target, for a camera that stands still: each frame is aligned by scale
and shift to the first one outside the target, and the standard deviation over time is taken pixel by pixel.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from gift_peft.colormap import color_range, colorize
from gift_peft.deploy.deployed import DeployedModel
from gift_peft.deploy.sensor import UnrelatedDepthError, robust_line
from gift_peft.deploy.sensor_files import read_mask
from gift_peft.files import jsonable, write_whole
from gift_peft.images import SUFFIXES

RATE = 30.0  # frames a second of a camera or clip that does not say it
MEMORY = 1.0  # seconds in which the colors follow a change of the whole scene
TALLEST = 720  # rows of the new clip; larger frames are reduced in it


@dataclass
class Flicker:
    """Standard deviation over time of aligned depth inside the target, in percent of the first frame's spread.

    The spread is P95 - P5 outside the target, so that models of any unit can be compared.
    """

    mask: np.ndarray
    count: int = 0
    _first: np.ndarray | None = None
    _mean: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _squares: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def update(self, depth: np.ndarray) -> None:
        """One frame's prediction (H,W) in native units."""
        if self._first is None:
            self._first = depth.astype(np.float64)
            self._mean = self._squares = np.zeros(np.count_nonzero(self.mask))
        outside = np.flatnonzero(~self.mask)[:: max(1, np.count_nonzero(~self.mask) // 4096)]
        try:
            scale, shift = robust_line(depth.ravel()[outside].astype(float), self._first.ravel()[outside],
                                       np.ones(len(outside)))  # fmt: skip
        except UnrelatedDepthError:
            scale, shift = 1.0, 0.0
        values = scale * depth[self.mask] + shift
        self.count += 1
        change = values - self._mean
        self._mean = self._mean + change / self.count
        self._squares = self._squares + change * (values - self._mean)

    def compute(self) -> float:
        """Percent; NaN before the second frame."""
        if self._first is None or self.count < 2:
            return float("nan")
        low, high = np.percentile(self._first[~self.mask], (5, 95))
        return float(100 * np.sqrt(self._squares / self.count).mean() / (high - low)) if high > low else float("nan")


def predict_video(
    source: str | Path,
    model: Any,
    out: str | Path,
    mask: str | Path | None = None,
    frames: int | None = None,
    batch_size: int = 1,
    progress: bool = True,
) -> dict[str, Any]:
    """Writes `<stem>_depth.mp4` (photo, base and adapted side by side) and `<stem>_depth.json` into a folder.

    Args:
        source: a clip, or the number of a camera ("0").
        model (`DepthModel` or `DeployedModel`): predicts; without an adapter (or the dial of an exported one) the clip
            shows photo and prediction.
        mask (*optional*): picture of the target, for the flicker inside it.
        frames (`int`, *optional*): stop after so many; a camera stops with Ctrl-C as well.
        batch_size (`int`): frames per forward.

    Returns:
        `dict`: `frames`, `seconds`, `frames_per_second` (of reading, predicting and writing), `flicker_percent`
        ({model: percent} with a mask), `clip` (path).

    Raises:
        FileNotFoundError: no such clip. ValueError: not a readable clip, no such camera, no frame in it; a prediction
            that is not finite; a mask of another shape.
    """
    capture, name = _open(source)
    rate = capture.get(cv2.CAP_PROP_FPS)
    rate = rate if np.isfinite(rate) and 1 <= rate <= 240 else RATE
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    total = min(total, frames or total) if total > 0 else frames
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    clip, partial = folder / f"{name}_depth.mp4", folder / f".{name}_depth.partial.mp4"
    if Path(source).exists() and clip.exists() and clip.samefile(source):
        capture.release()
        raise ValueError(f"{clip} would be written over the clip that is read: choose another --out")
    facts = clip.with_suffix(".json")
    if any(path.exists() for path in (clip, facts)) and not (facts.is_file() and b'"clip":' in facts.read_bytes()):
        capture.release()
        raise ValueError(f"{clip} was not written by gift-peft predict and is kept: choose another folder")
    models = _models(model)
    state = _Clip(partial, rate, models, model.kind or "inverse_depth", str(source))
    begin = time.perf_counter()
    quiet = None if progress else True
    try:
        for batch in _batches(_frames(capture, frames), batch_size):
            if state.flicker is None and mask is not None:
                target = read_mask(Path(mask), batch[0].shape[:2])
                state.flicker = {own: Flicker(target) for own in models}
            state.bar = state.bar or tqdm(total=total, desc="predict", unit="frame", disable=quiet)
            names = [f"{source}, frame {state.count + index}" for index in range(len(batch))]
            state.add(batch, _predict(model, batch, models, names))
    except KeyboardInterrupt:  # how a camera is stopped; what there is so far is kept
        if not state.count:
            raise
    except BaseException:
        state.close()
        partial.unlink(missing_ok=True)
        raise
    finally:
        capture.release()
    state.close()
    seconds = time.perf_counter() - begin
    if not state.count:
        partial.unlink(missing_ok=True)
        raise ValueError(f"{source}: no frame could be read from it")
    partial.replace(clip)
    result: dict[str, Any] = {"clip": str(clip), "frames": state.count, "seconds": seconds}
    result["frames_per_second"] = state.count / seconds
    if state.flicker is not None:
        result["flicker_percent"] = {own: flicker.compute() for own, flicker in state.flicker.items()}
    write_whole(clip.with_suffix(".json"), json.dumps(jsonable(result), indent=1) + "\n")
    return result


class _Clip:
    """The clip that is being written, its colors and what is measured on the way."""

    def __init__(self, path: Path, rate: float, models: list[str], kind: str, source: str) -> None:
        self.path, self.rate, self.models, self.kind, self.source = path, rate, models, kind, source
        self.writer: Any = None
        self.range: tuple[float, float] | None = None
        self.flicker: dict[str, Flicker] | None = None
        self.bar: Any = None
        self.count = 0

    def add(self, frames: list[np.ndarray], depths: dict[str, list[np.ndarray]]) -> None:
        for index, frame in enumerate(frames):
            own = {name: maps[index] for name, maps in depths.items()}
            low, high = color_range(*own.values())
            # Colors follow slowly: if each frame had a range of its own, they would flicker where depth does not.
            keep = 0.0 if self.range is None else 1 - 1 / max(1.0, MEMORY * self.rate)
            before = self.range or (low, high)
            self.range = keep * before[0] + (1 - keep) * low, keep * before[1] + (1 - keep) * high
            panels = [frame, *(colorize(depth, *self.range, self.kind)[..., ::-1] for depth in own.values())]
            self._write(np.concatenate(panels, axis=1))
            for name, depth in own.items():
                if self.flicker is not None:
                    self.flicker[name].update(depth)
            self.count += 1
            self.bar.update()

    def _write(self, picture: np.ndarray) -> None:
        factor = min(1.0, TALLEST / picture.shape[0])
        height, width = (max(2, round(side * factor) // 2 * 2) for side in picture.shape[:2])  # codecs want even sides
        picture = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=cv2.INTER_AREA)
        if self.writer is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self.writer = cv2.VideoWriter(str(self.path), code, self.rate, (width, height))
            if not self.writer.isOpened():
                raise ValueError(f"{self.path.parent}: no clip can be written there")
        self.writer.write(picture)

    def close(self) -> None:
        if self.writer is not None:
            self.writer.release()
        if self.bar is not None:
            self.bar.close()


def _models(model: Any) -> list[str]:
    """What stands beside the photo, by name; of an export without a dial nobody can tell the base any more."""
    if model.adapted:
        return ["base", "adapted"]
    return ["deployed"] if isinstance(model, DeployedModel) else ["base"]


def _open(source: str | Path) -> tuple[Any, str]:
    """The open clip or camera, and the stem of what is written."""
    if str(source).isdigit() and not Path(source).exists():
        capture, name = cv2.VideoCapture(int(source)), f"camera_{source}"
        trouble = f"camera {source}: it cannot be opened"
    else:
        if not Path(source).is_file():
            raise FileNotFoundError(f"{source}: no such clip")
        if Path(source).suffix.lower() in SUFFIXES:  # OpenCV takes 01.jpg for a clip of 01.jpg, 02.jpg ...
            raise ValueError(f"{source}: a picture, not a clip; leave --video out")
        capture, name = cv2.VideoCapture(str(source)), Path(source).stem
        trouble = f"{source}: not a clip that can be read"
    if not capture.isOpened():
        raise ValueError(trouble)
    return capture, name


def _frames(capture: Any, limit: int | None) -> Iterator[np.ndarray]:
    """(H,W,3) uint8 in OpenCV's order of colors."""
    count = 0
    while limit is None or count < limit:
        there, frame = capture.read()
        if not there:
            return
        count += 1
        yield frame


def _batches(frames: Iterator[np.ndarray], size: int) -> Iterator[list[np.ndarray]]:
    batch = []
    for frame in frames:
        batch.append(frame)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


def _predict(model: Any, frames: list[np.ndarray], models: list[str], names: list[str]) -> dict[str, list[np.ndarray]]:
    from PIL import Image

    pictures = [Image.fromarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)) for frame in frames]
    pixels, sizes = model.inputs(pictures), [frame.shape[:2] for frame in frames]
    return {own: model.depths_of(pixels, sizes, names, base=own == "base") for own in models}
