"""`gift-peft deploy --to space`: a folder with a page to try an adapter in, here or as a Hugging Face Space.

Its model is the ONNX graph with a dial, so that the page needs neither torch nor this package.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from gift_peft.deploy import space_app
from gift_peft.deploy.bundle import OWN as EXPORTED
from gift_peft.deploy.bundle import Bundle, prepare_bundle, write_bundle
from gift_peft.deploy.onnx_export import require_onnx, write_onnx
from gift_peft.deploy.stages import stages
from gift_peft.files import is_hub_id, portable_name, whole_folder
from gift_peft.images import list_images, read_image
from gift_peft.options import package_version

OWN = (*EXPORTED, "app.py", "requirements.txt", "about.json", "examples/*", ".gitattributes")
GRADIO = "6.31.0"  # what the page was tried with, where none is installed
EXAMPLES = 3  # photos of the embedded groups, where none are given
EXAMPLE_SIDE = 1280
EMBEDDED = Path(__file__).parents[1] / "demo" / "gift-i" / "data"
LARGE = "*.onnx filter=lfs diff=lfs merge=lfs -text\n*.data filter=lfs diff=lfs merge=lfs -text\n"


def deploy_space(
    adapter: str | Path,
    out: str | Path,
    base: str | Path | None = None,
    *,
    examples: Sequence[str | Path] = (),
    **options: Any,
) -> Path:
    """Write `out`: app.py, its model with a dial, requirements, card and example photos; returns it.

    Args:
        adapter, base: as in `load_for_deployment`, and `options` but for the scale, which the page's visitors choose.
        examples: photos, or folders of them; default some of the embedded, rendered ones.

    Raises as `deploy_onnx`, and ValueError or FileNotFoundError for an example that cannot be read.
    """
    require_onnx()
    photos = _photos(examples)
    with stages(3) as stage:
        stage("the model")
        bundle = prepare_bundle(adapter, out, base, "space", own=OWN, dial=True, **options)
        with whole_folder(bundle.out, OWN) as folder:
            stage("its graph, a minute for small and several for large models")
            write_onnx(bundle, folder / "model.onnx")
            stage("comparison with torch")
            write_bundle(bundle, folder, "onnx")
            _write_page(bundle, folder, adapter, photos)
    return bundle.out


def _photos(examples: Sequence[str | Path]) -> dict[str, Image.Image]:
    """{file name: photo} of those given, else the first photo of some embedded groups."""
    if examples:
        found = {f"{path.stem}.jpg": read_image(path) for path in list_images(examples)}
    else:
        from pyarrow import parquet

        files = sorted(EMBEDDED.glob("validation-*.parquet"))
        rows = parquet.read_table(files[0], columns=["group_id", "images"]).slice(0, EXAMPLES).to_pylist()
        found = {f"{row['group_id']}.jpg": read_image(row["images"][0]["bytes"], row["group_id"]) for row in rows}
    for photo in found.values():
        if max(photo.size) > EXAMPLE_SIDE:
            photo.thumbnail((EXAMPLE_SIDE, EXAMPLE_SIDE), Image.Resampling.LANCZOS)
    return found


def _write_page(bundle: Bundle, folder: Path, adapter: Any, photos: dict[str, Image.Image]) -> None:
    name = portable_name(bundle.base)
    title = f"{name.split('/')[-1]} on mirrors and glass"
    text = (
        f"Depth from one photo: the base model {name} beside the same model with the GIFT adapter "
        f"{portable_name(adapter)}, trained without depth labels to see the surfaces of mirrors and glass. "
        f"License of the weights: {bundle.license if bundle.license != 'other' else 'see the base model'}."
    )
    (folder / "app.py").write_text(Path(space_app.__file__).read_text(encoding="utf-8"), encoding="utf-8")
    about = {"title": title, "text": text, "unit": bundle.settings["unit"]}
    (folder / "about.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    gradio = package_version("gradio")
    gradio = GRADIO if gradio == "not installed" else gradio
    # gradio 6 takes Pillow below 13.
    requirements = f"gradio=={gradio}\nnumpy>=2\nonnxruntime>=1.23\npillow>=11.3,<13\n"
    (folder / "requirements.txt").write_text(requirements, encoding="utf-8")
    (folder / ".gitattributes").write_text(LARGE, encoding="utf-8")  # a Space is a git repository
    (folder / "examples").mkdir()
    for file, photo in photos.items():
        photo.save(folder / "examples" / file, "JPEG", quality=92)
    front = {
        "title": title,
        "sdk": "gradio",
        "sdk_version": gradio,
        "app_file": "app.py",
        "license": bundle.license,
        "models": [str(model) for model in (bundle.base, adapter) if is_hub_id(model) and "/" in str(model)],
        "tags": ["depth-estimation", "gift", "transparent-objects", "mirrors"],
        "short_description": "Depth of mirrors and glass, before and after",
    }
    card = f"---\n{yaml.safe_dump(front, sort_keys=False)}---\n\n# {title}\n\n{text}\n\n"
    card += "Here: `pip install -r requirements.txt`, then `python app.py`. On the Hub: a Space of these files.\n"
    card += "`model.onnx` and what stands beside it can be used without the page:\n\n"
    exported = (folder / "README.md").read_text(encoding="utf-8").split("\n", 1)[1].lstrip("\n")
    (folder / "README.md").write_text(card + exported, encoding="utf-8")
