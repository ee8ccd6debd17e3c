"""Rendered groups with all that the frozen base says about them, predicted once and kept.

A set is a folder of groups as `examples/tools/embedded/render_groups.py` leaves them. Per observation: the base's
prediction of the photo, of its mirror image and of its fills (both ways round), the treated reference's, true depth,
and the renderer's own record of whether the surface can be seen.
"""

import hashlib
import json
import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from gift_peft.models.loading import DepthModel
from gift_peft.rules import GroupPictures
from gift_peft.surface_targets import paint_fills

SIZE = 112, 140
FILLS = 6


@dataclass
class Observed:
    """A group: N observations of (H, W) = 112x140, F fills of each.

    `base`, `base_flipped` (N,H,W), `fills`, `fills_flipped` (N,F,H,W), `reference` (H,W): float32 in native units
    (inverse depth). `images` (N,H,W,3) uint8, `mask` (H,W) bool, `depths` (N,H,W) mm, `seen` (N,) bool.
    """

    name: str
    kind: str
    images: np.ndarray
    mask: np.ndarray
    depths: np.ndarray
    seen: np.ndarray
    treated: np.ndarray
    base: np.ndarray
    base_flipped: np.ndarray
    fills: np.ndarray
    fills_flipped: np.ndarray
    reference: np.ndarray

    def only(self, chosen) -> "Observed":
        """The same group with these observations alone."""
        per_image = ("images", "depths", "seen", "base", "base_flipped", "fills", "fills_flipped")
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Observed(**{name: value[chosen] if name in per_image else value for name, value in values.items()})

    def pictures(self) -> GroupPictures:
        """As the evaluation takes a group."""
        count = len(self.images)
        return GroupPictures(
            group_id=self.name,
            names=[f"{index:02d}" for index in range(count)],
            images=[Image.fromarray(image) for image in self.images],
            masks=[self.mask] * count,
            depths=list(self.depths),
            reference=Image.fromarray(self.treated),
            surface="mirror" if self.kind == "mirror" else "transparent",
        )


def fingerprint(base: Path) -> str:
    """Eight hex digits of a base model's weights."""
    return hashlib.blake2b((base / "model.safetensors").read_bytes(), digest_size=4).hexdigest()


def read_set(folder: Path, base: Path, fills: int = FILLS) -> list[Observed]:
    """All groups of a set, in the order of their names; what was predicted before is read from `<set>.<base>/`."""
    store = folder.with_name(f"{folder.name}.{fingerprint(base)}")
    store.mkdir(exist_ok=True)
    names = sorted(path.parent.name for path in folder.glob("*/group.json"))
    model = None
    groups = []
    for name in tqdm(names, f"base on {folder.name}", unit="group", delay=2):
        kept = store / f"{name}.npz"
        if not kept.exists():
            model = model or DepthModel.from_pretrained(base, size=SIZE)
            _write(kept, _observe(folder / name, model, fills))
        with np.load(kept) as arrays:
            values = {key: arrays[key] for key in arrays.files}
        facts = json.loads((folder / name / "group.json").read_text())
        groups.append(Observed(name=name, kind=facts["kind"], seen=np.array(facts["surface_seen"]), **values))
    return groups


def _observe(folder: Path, model: DepthModel, count: int) -> dict[str, np.ndarray]:
    images = [Image.open(path).convert("RGB") for path in sorted(folder.glob("images/*.jpg"))]
    mask = np.asarray(Image.open(folder / "masks" / "00.png")) >= 128
    treated = Image.open(folder / "reference.jpg").convert("RGB")
    pixels = model.inputs(images)
    painted = [
        torch.cat([model.inputs([Image.fromarray(fill)]) for fill in paint_fills(np.asarray(image), mask, count)])
        for image in images
    ]
    return {
        "images": np.stack([np.asarray(image) for image in images]),
        "mask": mask,
        "depths": np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("depths/*.png"))]),
        "treated": np.asarray(treated),
        "base": model.predict(pixels).numpy(),
        "base_flipped": model.predict(pixels.flip(-1)).numpy(),
        "fills": np.stack([model.predict(each).numpy() for each in painted]),
        "fills_flipped": np.stack([model.predict(each.flip(-1)).numpy() for each in painted]),
        "reference": model.predict(model.inputs([treated]))[0].numpy(),
    }


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    temporary = path.with_name(path.name + ".part")
    with open(temporary, "wb") as file:
        np.savez(file, **arrays)
    os.replace(temporary, path)
