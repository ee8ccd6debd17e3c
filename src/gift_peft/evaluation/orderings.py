"""Benchmarks that ask a depth map only which point lies behind which: nothing has to be aligned.

A question is a list of points of one photo; it is answered right if predicted depth strictly grows along it. Accuracy
is right / all over the questions of all photos. `layered_depth` and `md3k` beside it read the data.
"""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gift_peft.adapters.scale import scale_comes_back, set_adapter_scale
from gift_peft.evaluation.alignment import resize_prediction, to_numpy
from gift_peft.evaluation.results import write_results
from gift_peft.evaluation.stored_predictions import find_stored, read_stored, require_stored
from gift_peft.files import jsonable
from gift_peft.images import read_image
from gift_peft.models.loading import DepthModel
from gift_peft.rules import KINDS

DIAL_SCALES = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, eq=False)
class PhotoQuestions:
    """One photo of such a benchmark.

    Args:
        name (`str`): in the rows, and of its stored prediction.
        path (`Path`): the photo.
        questions (`dict[str, np.ndarray]`): {subset: (T, n, 2) points as x, y in pixels}, depth growing along n.
    """

    name: str
    path: Path
    questions: Mapping[str, np.ndarray]


@dataclass(kw_only=True)
class OrderingReport:
    """The result of `evaluate_layered_depth` and `evaluate_md3k`.

    Args:
        dataset (`str`): `layereddepth` or `md3k`.
        summary (`dict[str, float]`): accuracy (0 to 1, NaN without a question) per subset of the evaluated model; on
            MD-3k also `alpha`.
        base (`dict`, *optional*): the same of the frozen model, where an adapter was evaluated beside it.
        counts (`dict`): `photos`; `questions` and `outside` per subset: those counted, and those with a point outside
            the photo, which are skipped.
        adapted (`bool`): whether `summary` is of an adapted model.
        dial (`list[dict]`): `scale` and the summary at this adapter scale, where it was asked for.
        notes (`list[str]`): what stands under the table: the definition, the source and its license.
        rows (`list[dict]`): per photo `image`, `questions` and `outside` per subset, and the right answers of `base`
            and `adapted`.
        about (`dict`): `root`, `kind` and, where the caller knows, `base`, `adapter`, `predictions`.
    """

    dataset: str
    summary: dict
    base: dict | None
    counts: dict
    adapted: bool
    dial: list[dict] = field(default_factory=list)
    notes: list[str]
    rows: list[dict] = field(repr=False)
    about: dict = field(default_factory=dict)

    def to_dict(self) -> dict:
        """Everything but the rows, in JSON types; NaN becomes None."""
        return jsonable({item.name: getattr(self, item.name) for item in fields(self) if item.name != "rows"})

    def save(self, folder: str | Path) -> Path:
        """Writes `metrics.json` and `rows.jsonl`, each at once or not at all; returns the folder."""
        return write_results(folder, self.rows, self.to_dict())

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "OrderingReport":
        """What `to_dict` gave, without rows; ValueError for anything else."""
        known = {item.name for item in fields(cls)} - {"rows"}
        if values.keys() != known:
            raise ValueError(f"no evaluation of orderings: it needs {', '.join(sorted(known))}")
        return cls(rows=[], **values)


def count_right(depth: Any, questions: np.ndarray, kind: str = "depth") -> tuple[int, int, int]:
    """(right, counted, outside) of the questions about one photo.

    Coordinates are cut to whole pixels. A question with a point outside the photo is skipped. Equal values are wrong.

    Args:
        depth (`np.ndarray` or `torch.Tensor`): (H, W) prediction at the photo's size; finite where a point lies.
        questions (`np.ndarray`): (T, n, 2) points as x, y.
        kind (`str`): what the prediction is; inverse depth has to shrink along a question.

    Raises ValueError for an unknown kind, another shape, and a point at which the prediction is not finite.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    values = to_numpy(depth, np.float64)
    if values.ndim != 2:
        raise ValueError(f"depth must be (H, W), got {values.shape}")
    points = np.trunc(np.asarray(questions, np.float64)).astype(np.int64)
    if points.ndim != 3 or points.shape[-1] != 2:
        raise ValueError(f"questions must be (T, n, 2), got {points.shape}")
    x, y = points[..., 0], points[..., 1]
    inside = ((x >= 0) & (x < values.shape[1]) & (y >= 0) & (y < values.shape[0])).all(axis=1)
    answers = values[y[inside], x[inside]]
    if not np.isfinite(answers).all():
        raise ValueError("the prediction has NaN or infinite values")
    steps = np.diff(answers if kind == "depth" else -answers, axis=1)
    return int(np.count_nonzero((steps > 0).all(axis=1))), len(answers), int(np.count_nonzero(~inside))


Predictors = Mapping[str, Callable[[PhotoQuestions], Any]]


def evaluate_orderings(
    dataset: str,
    photos: Sequence[PhotoQuestions],
    model: Any,
    predictions: str | Path | None,
    kind: str | None,
    *,
    derive: Callable[[dict], dict],
    notes: Sequence[str],
    dial: Sequence[float] = (),
    teacher: Any = None,
    processor: Any = None,
    size: tuple[int, int] | None = None,
    progress: bool = True,
) -> OrderingReport:
    """The report of a model beside its base, or of stored predictions, on the photos.

    `derive` adds to the accuracies what a benchmark computes from them. With `dial`, the adapter is evaluated at each
    of these scales as well, and has its own scale again afterwards.

    Raises:
        ValueError: neither or both of model and predictions, no kind, a dial without an adapter, with a merged one or
            with a scale that is not finite, no question at all, NaN in a prediction (naming the photo).
        FileNotFoundError: a photo or a stored prediction that is missing.
    """
    if (model is None) == (predictions is None):
        raise ValueError("an evaluation takes a model or predictions, one of the two")
    if any(not math.isfinite(scale) for scale in dial):
        raise ValueError(f"dial: {', '.join(map(str, dial))}; scales are finite numbers")
    missing = [photo.path for photo in photos if not photo.path.is_file()]
    if missing:
        raise FileNotFoundError(f"{len(missing)} photos are missing, the first is {missing[0]}")
    depth_model = None
    if predictions is not None:
        if kind is None:
            raise ValueError('say what the predictions are: kind="depth" or kind="inverse_depth"')
        predictors: Predictors = {"base": _stored(Path(predictions), photos)}
    else:
        depth_model = DepthModel.of(model, teacher=teacher, processor=processor, size=size, kind=kind)
        kind, predictors = depth_model.known_kind(), _predictors(depth_model)
    if dial and (depth_model is None or not hasattr(depth_model.network, "disable_adapter")):
        raise ValueError("the layer dial turns an adapter: name one")
    # A merged adapter is refused before the base is predicted, which would unmerge it.
    with scale_comes_back(depth_model.network) if dial and depth_model else contextlib.nullcontext():
        rows = _answers(photos, predictors, kind, progress, "evaluate")
        turned = [(scale, _turn(photos, depth_model, kind, scale, progress)) for scale in dial]
    subsets = list(dict.fromkeys(name for photo in photos for name in photo.questions))
    counts: dict[str, Any] = {"photos": len(photos)}
    for name in ("questions", "outside"):
        counts[name] = {subset: sum(row[name].get(subset, 0) for row in rows) for subset in subsets}
    if not any(counts["questions"].values()):
        raise ValueError(f"{dataset}: no question lies inside its photo")

    def summary(answers: list[dict], name: str) -> dict:
        return derive({subset: _accuracy(answers, name, subset) for subset in subsets})

    adapted = "adapted" in predictors
    return OrderingReport(
        dataset=dataset,
        summary=summary(rows, "adapted" if adapted else "base"),
        base=summary(rows, "base") if adapted else None,
        counts=counts,
        adapted=adapted,
        dial=[{"scale": scale} | summary(answers, "adapted") for scale, answers in turned],
        notes=list(notes),
        rows=rows,
        about={"kind": kind, "predictions": predictions and str(predictions)},
    )


def _predictors(model: DepthModel) -> Predictors:
    """Base and, where there is an adapter or a teacher, adapted, each as `gift-peft predict` writes it."""
    base = {"base": lambda photo: model.depth_at(photo.path, base=True)}
    return base | ({"adapted": lambda photo: model.depth_at(photo.path)} if model.adapted else {})


def _stored(folder: Path, photos: Sequence[PhotoQuestions]) -> Callable[[PhotoQuestions], np.ndarray]:
    """Reads the stored prediction of a photo: `<name without suffix>`, or `<name>_1` as LayeredDepth's evaluator."""

    def find(photo: PhotoQuestions) -> Path | None:
        place = folder / Path(photo.name).parent
        stem = Path(photo.name).stem
        return find_stored(place, stem) or find_stored(place, f"{stem}_1")

    require_stored(folder, ((str(Path(photo.name).with_suffix("")), find(photo)) for photo in photos))

    def read(photo: PhotoQuestions) -> np.ndarray:
        path = find(photo)
        assert path is not None  # required above
        width, height = read_image(photo.path).size
        return resize_prediction(read_stored(path), (height, width))

    return read


def _answers(
    photos: Sequence[PhotoQuestions], predictors: Predictors, kind: str, progress: bool, what: str
) -> list[dict]:
    """One row per photo."""
    rows = []
    for photo in tqdm(photos, desc=what, unit="photo", disable=None if progress else True):
        row: dict[str, Any] = {"image": photo.name, "questions": {}, "outside": {}}
        for name, predict in predictors.items():
            depth = predict(photo)
            row[name] = {}
            for subset, questions in photo.questions.items():
                try:
                    right, counted, outside = count_right(depth, questions, kind)
                except ValueError as error:
                    raise ValueError(f"{photo.path}: {error}") from None
                row[name][subset] = right
                row["questions"][subset], row["outside"][subset] = counted, outside
        rows.append(row)
    return rows


def _accuracy(rows: list[dict], model: str, subset: str) -> float:
    counted = sum(row["questions"].get(subset, 0) for row in rows)
    return sum(row[model].get(subset, 0) for row in rows) / counted if counted else math.nan


def _turn(photos: Sequence[PhotoQuestions], model: Any, kind: str, scale: float, progress: bool) -> list[dict]:
    """Rows of the adapter at a scale."""
    set_adapter_scale(model.network, scale)
    return _answers(photos, {"adapted": lambda photo: model.depth_at(photo.path)}, kind, progress, f"scale {scale:+g}")
