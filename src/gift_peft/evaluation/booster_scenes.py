"""Booster: scenes with mirrors and glass, measured disparity, material classes, several illuminations of one pose.

    <root>/[train/][balanced|unbalanced/]<Scene>/camera_00/*.png
                                                /disp_00.npy, mask_00.png, mask_cat.png, calib_00-02.xml

read as it is unpacked (Zama Ramirez et al., "Booster: a benchmark for depth from images of specular and transparent
surfaces"). depth_mm = proj_matL[0,0] * baselineLR / disparity; 0 marks what is unknown.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gift_peft.files import is_leftover, reason
from gift_peft.images import SINGLE_CHANNEL, natural_key, open_image, sort_pictures, to_mask

SUBSETS = ("balanced", "unbalanced")
OCCLUSIONS = ("all", "noc")
CLASSES = (0, 1, 2, 3)  # from opaque and matt to transparent or mirroring
TOM_CLASSES = (2, 3)
DEPTH_RANGE = (1.0, 10000.0)  # mm; ground truth outside of it is dropped
CAMERA = "camera_00"
CALIBRATIONS = ("calib_00-02.xml", "calib_00-01.xml")  # the second pairs camera_00 with the unbalanced camera
OFFICIAL_IMAGES = 228
OFFICIAL_SCENES = {
    "Bathroom", "Bedroom", "Bottle", "Bottle1", "BottledWater", "Bottles1", "Bucket", "Canteen", "Case",
    "CashBox", "CoffeeMaker", "Cooker1", "Cosmetics", "DogHouse", "Door", "ExtractorFan", "Fridge", "Lunch",
    "Microwave", "Mirror", "Moka", "Moka1", "Motorcycle", "Mouthwash", "OilCan", "Oven1", "Oven2", "Pots1",
    "Shower", "Sink", "SoapDishes", "Tablet", "Toilet", "TV", "TV1", "TV2", "Vodka", "Washer",
}  # fmt: skip


@dataclass(frozen=True)
class BoosterScene:
    """One pose and geometry.

    Args:
        name (`str`): of its folder.
        folder (`Path`): with ground truth, masks and calibration.
        images (`tuple[Path, ...]`): left images, one per illumination, in natural order.
    """

    name: str
    folder: Path
    images: tuple[Path, ...]


@dataclass(frozen=True)
class GroundTruth:
    """What is known of a scene, at the size of the evaluation.

    Args:
        depth (`np.ndarray`): (H,W) float64 in mm, 0 where unknown or left out.
        tom (`np.ndarray`): (H,W) bool, transparent or mirroring.
        full_size (`tuple[int, int]`): (height, width) of disparity, masks and images on disk.
    """

    depth: np.ndarray
    tom: np.ndarray
    full_size: tuple[int, int]


@dataclass(frozen=True)
class Booster:
    """The scenes under a root.

    Args:
        scenes (`list[BoosterScene]`): in natural order.
        subset (`str`, *optional*): `balanced`, `unbalanced`, or None where the layout does not say.
        official (`bool`): whether they are the 38 scenes and 228 images of the official training set, by name and
            number.
    """

    scenes: list[BoosterScene]
    subset: str | None
    official: bool


def find_booster(root: str | Path, subset: str | None = None, official: bool | None = None) -> Booster:
    """The scenes under `root`, which may be the folder of `train`, of `balanced` and `unbalanced`, or of the scenes.

    Args:
        root: folder.
        subset (`str`, *optional*): `balanced` or `unbalanced`; default balanced, else what there is.
        official (`bool`, *optional*): True asks for the complete official training set, False for no check. By
            default a root that holds most of its scenes claims to be it, and has to be complete.

    Raises:
        FileNotFoundError: no such folder, no scenes, a scene without images.
        ValueError: an unknown subset, two images of one stem, an incomplete official set.
    """
    root = Path(root)
    if subset not in (None, *SUBSETS):
        raise ValueError(f"unknown subset {subset!r}: choose one of {', '.join(SUBSETS)}")
    if not root.is_dir():
        raise FileNotFoundError(f"Booster root {root}: no such folder")
    parent, found = _scenes_folder(root, subset)
    scenes = [_scene(folder) for folder in _subfolders(parent)]
    return Booster(scenes, found, _is_official(root, scenes, official))


def read_ground_truth(
    scene: BoosterScene, resize: float = 0.25, occlusion: str = "all", tom_classes: Sequence[int] = TOM_CLASSES
) -> GroundTruth:
    """Disparity, masks and calibration of a scene as depth and target.

    Arrays are reduced by OpenCV's nearest neighbour, disparity and focal length by the same factor, and disparity is
    dropped where it is not positive or its depth lies outside `DEPTH_RANGE`, as Depth4ToM's evaluator does.

    Args:
        scene (`BoosterScene`): from `find_booster`.
        resize (`float`): factor in (0, 1].
        occlusion (`str`): `all`, or `noc`: only what the right camera sees as well (`mask_00.png`).
        tom_classes: of `mask_cat.png`; those of transparent and mirroring surfaces.

    Raises:
        FileNotFoundError, ValueError: naming the file that is missing, damaged or of another size, or the argument.
    """
    _check_options(resize, occlusion, tom_classes)
    disparity = _read_disparity(scene.folder / "disp_00.npy")
    if min(disparity.shape) * resize < 1:
        raise ValueError(f"resize {resize}: no pixel is left of {disparity.shape[0]}x{disparity.shape[1]}")
    classes = _read_classes(scene.folder / "mask_cat.png", disparity.shape)
    focal, baseline = read_calibration(_calibration(scene.folder))
    keep = disparity > 0
    if occlusion == "noc":
        path = scene.folder / "mask_00.png"
        visible = to_mask(open_image(path), str(path))
        _check_size(path, visible.shape, disparity.shape)
        keep &= visible
    shape = disparity.shape
    disparity = _reduce(np.where(keep, disparity, np.float32(0)), resize)
    # In float32, as in the published evaluator: its comparisons with the limits are of these values.
    disparity = (disparity * np.float32(resize)).astype(np.float64)
    product = focal * resize * baseline
    near, far = DEPTH_RANGE
    keep = (disparity > 0) & (disparity <= product / near) & (disparity >= product / far)
    depth = np.divide(product, disparity, out=np.zeros(disparity.shape), where=keep)
    return GroundTruth(depth, np.isin(_reduce(classes, resize), tom_classes), shape)


def read_calibration(path: str | Path) -> tuple[float, float]:
    """(focal length in px of the rectified left camera, baseline in mm) of an OpenCV XML file.

    Raises FileNotFoundError or ValueError naming the file and the entry.
    """
    try:
        tree = ET.parse(path).getroot()
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except ET.ParseError as error:
        raise ValueError(f"{path}: not valid XML ({error})") from None
    values = []
    for name, entry in (("proj_matL", "proj_matL/data"), ("baselineLR", "baselineLR")):
        text = (tree.findtext(entry) or "").split()
        try:
            values.append(float(text[0]))
        except (IndexError, ValueError):
            raise ValueError(f"{path}: {name} is missing, or not a number") from None
        if not (np.isfinite(values[-1]) and values[-1] > 0):
            raise ValueError(f"{path}: {name} starts with {values[-1]:g}; it has to be positive")
    return values[0], values[1]


# ---- finding ----


def _scenes_folder(root: Path, subset: str | None) -> tuple[Path, str | None]:
    """The folder whose subfolders are scenes, and the subset it is of."""
    here = root.name if root.name in SUBSETS else None
    if _holds_scenes(root):
        if subset not in (None, here):
            raise ValueError(f"Booster root {root} holds scenes itself: name its parent to choose {subset}")
        return root, here
    for name in (subset,) if subset else SUBSETS:
        for folder in (root / name, root / "train" / name):
            if _holds_scenes(folder):
                return folder, name
    if subset is None and _holds_scenes(root / "train"):
        return root / "train", None
    wanted = f"{subset}/<Scene>" if subset else "<Scene>, balanced/<Scene> or train/balanced/<Scene>"
    raise FileNotFoundError(f"Booster root {root}: no scenes; expected {wanted}/{CAMERA}/*.png below it")


def _holds_scenes(folder: Path) -> bool:
    return folder.is_dir() and any((scene / CAMERA).is_dir() for scene in _subfolders(folder))


def _subfolders(folder: Path) -> list[Path]:
    folders = (path for path in folder.iterdir() if path.is_dir() and not is_leftover(path.name))
    return sorted(folders, key=lambda path: natural_key(path.name))


def _scene(folder: Path) -> BoosterScene:
    camera = folder / CAMERA
    images = sort_pictures(camera.iterdir()) if camera.is_dir() else []
    if not images:
        raise FileNotFoundError(f"Booster scene {folder}: no images in {CAMERA}/")
    stems: dict[str, Path] = {}
    for image in images:
        if stems.setdefault(image.stem, image) != image:
            raise ValueError(f"{image} and {stems[image.stem].name} would share one prediction; remove one of them")
    return BoosterScene(folder.name, folder, tuple(images))


def _is_official(root: Path, scenes: list[BoosterScene], official: bool | None) -> bool:
    names = {scene.name for scene in scenes}
    images = sum(len(scene.images) for scene in scenes)
    complete = names == OFFICIAL_SCENES and images == OFFICIAL_IMAGES
    claims = len(names & OFFICIAL_SCENES) > len(OFFICIAL_SCENES) / 2 if official is None else official
    if claims and not complete:
        parts = [f"{len(names)} of {len(OFFICIAL_SCENES)} scenes and {images} of {OFFICIAL_IMAGES} images"]
        for title, group in (("missing", OFFICIAL_SCENES - names), ("unknown", names - OFFICIAL_SCENES)):
            if group:
                parts.append(f"{title}: {', '.join(sorted(group)[:10])}{', ...' if len(group) > 10 else ''}")
        raise ValueError(
            f"Booster root {root} is not the complete official training set: {'; '.join(parts)} (official=False, or "
            "--partial, evaluates what is there)"
        )
    return complete


# ---- reading ----


def _check_options(resize: float, occlusion: str, tom_classes: Sequence[int]) -> None:
    if not 0 < resize <= 1:
        raise ValueError(f"resize {resize}: a factor above 0 and up to 1")
    if occlusion not in OCCLUSIONS:
        raise ValueError(f"unknown occlusion {occlusion!r}: choose one of {', '.join(OCCLUSIONS)}")
    if not tom_classes or not set(tom_classes) <= set(CLASSES):
        raise ValueError(f"tom_classes {tuple(tom_classes)}: some of {', '.join(map(str, CLASSES))}")


def _read_disparity(path: Path) -> np.ndarray:
    """(H,W) float32 in px."""
    try:
        disparity = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: not a readable npy file ({reason(error)})") from None
    if not isinstance(disparity, np.ndarray) or disparity.ndim != 2 or disparity.dtype.kind not in "fiu":
        found = f"{disparity.dtype} {disparity.shape}" if isinstance(disparity, np.ndarray) else "an archive"
        raise ValueError(f"{path}: {found}; disparity is (H,W) numbers")
    return disparity.astype(np.float32, copy=False)


def _read_classes(path: Path, shape: tuple[int, int]) -> np.ndarray:
    image = open_image(path)
    if image.mode not in SINGLE_CHANNEL:
        raise ValueError(f"{path}: mode {image.mode}; material classes are one channel")
    classes = np.asarray(image)
    _check_size(path, classes.shape, shape)
    odd = classes.max(initial=0) if classes.max(initial=0) > max(CLASSES) else classes.min(initial=0)
    if odd not in CLASSES:
        raise ValueError(f"{path}: class {odd}; the material classes are {', '.join(map(str, CLASSES))}")
    return classes.astype(np.uint8)


def _check_size(path: Path, shape: tuple[int, int], wanted: tuple[int, int]) -> None:
    if shape != wanted:
        found, expected = (f"{height}x{width}" for height, width in (shape, wanted))
        raise ValueError(f"{path} is {found} (height x width), but disp_00.npy is {expected}")


def _calibration(folder: Path) -> Path:
    return next((folder / name for name in CALIBRATIONS if (folder / name).is_file()), folder / CALIBRATIONS[0])


def _reduce(array: np.ndarray, resize: float) -> np.ndarray:
    return cv2.resize(array, None, fx=resize, fy=resize, interpolation=cv2.INTER_NEAREST)
