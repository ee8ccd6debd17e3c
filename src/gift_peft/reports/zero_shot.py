"""Any photographs under the base and under the checkpoints of a run (paper, supplement C.1): how training drifts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from gift_peft.evaluation.alignment import resize_prediction
from gift_peft.images import list_images, read_image
from gift_peft.models.loading import DepthModel
from gift_peft.reports.figures import prediction_row, save_grid
from gift_peft.reports.saved_run import SavedRun

LONG_SIDE = 720  # of a picture in the figure


def checkpoint_folders(run: SavedRun, steps: Sequence[int] = ()) -> dict[int, Path]:
    """{step: folder} of a run's checkpoints: `steps`, else those it was told to keep and has, else all there are.

    Raises FileNotFoundError for a step without a checkpoint, or a run without any.
    """
    present = {
        int(path.name.split("-")[1]): path
        for path in run.path.glob("checkpoint-*")
        if path.name.split("-")[1].isdigit() and (path / "adapter_config.json").is_file()
    }
    kept = [step for step in run.arguments.get("checkpoint_at_steps") or [] if step in present]
    wanted = list(steps) or kept or sorted(present)
    for step in wanted:
        if step not in present:
            listed = ", ".join(map(str, sorted(present))) or "none"
            raise FileNotFoundError(
                f"{run.path} has no checkpoint of step {step} (there are: {listed}); "
                "--checkpoint_at_steps keeps chosen ones in training"
            )
    if not wanted:
        raise FileNotFoundError(f"{run.path} has no checkpoints")
    return {step: present[step] for step in wanted}


def draw_zero_shot(
    run: SavedRun,
    images: Sequence[str | Path],
    steps: Sequence[int],
    paths: Sequence[Path],
    device: str | None = None,
) -> None:
    """One row per picture: RGB, base, and each checkpoint, in native units and one colour range; near is bright.

    Args:
        run: with the base's name in its arguments, and checkpoints.
        images: files, or folders of them.
        steps: of the checkpoints; see `checkpoint_folders`.
        paths: files to write, .png or .pdf.
        device (*optional*): for the models.

    Raises:
        FileNotFoundError: a picture, checkpoint or base that is not there.
        ValueError: a prediction that is not finite; a base that does not say what it predicts.
    """
    files = list_images(images)
    folders = checkpoint_folders(run, steps)
    pictures = [_fit(read_image(file)) for file in files]
    maps: list[list[np.ndarray]] = [[] for _ in files]
    kind = (run.record or {}).get("kind")
    bar = tqdm(total=len(files) * (len(folders) + 1), desc="zero-shot", unit="image", disable=None)
    with bar:
        for number, folder in enumerate(folders.values()):
            model = DepthModel.from_pretrained(
                run.arguments["model_name_or_path"],
                folder,
                revision=run.arguments.get("model_revision"),
                size=run.arguments.get("size"),
                device=device,
            )
            kind = kind or model.kind
            for predict in (model.predict_base, model.predict) if number == 0 else (model.predict,):
                for file, picture, own in zip(files, pictures, maps, strict=True):
                    depth = predict(model.inputs([read_image(file)]))[0]
                    if not torch.isfinite(depth).all():
                        raise ValueError(f"{file}: the prediction has NaN or infinite values")
                    own.append(resize_prediction(depth, (picture.height, picture.width)).astype(np.float32))
                    bar.update()
    if kind is None:
        raise ValueError(f"{run.path}: nothing says whether the base predicts depth or inverse depth")
    rows = [
        prediction_row(file.name, picture, depths, kind)
        for file, picture, depths in zip(files, pictures, maps, strict=True)
    ]
    for path in paths:
        save_grid(rows, ("RGB", "base", *(f"{step:,} steps" for step in folders)), path)


def _fit(image):
    """At most LONG_SIDE on its long side, and never enlarged."""
    factor = min(1.0, LONG_SIDE / max(image.size))
    return image if factor == 1 else image.resize([max(1, round(factor * side)) for side in image.size])
