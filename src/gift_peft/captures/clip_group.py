"""A group whose folder holds clips in place of photos: its files, before anything is decoded."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from gift_peft.captures.clip import TimeInClip, find_clips, read_time
from gift_peft.captures.folders import PICTURE_MASKS, Listing, files_below
from gift_peft.captures.group_facts import GROUP_FILES, read_facts
from gift_peft.captures.links import checked
from gift_peft.captures.masks import MaskSource, find_group_mask, is_group_mask, is_mask_file
from gift_peft.captures.tree import is_reference
from gift_peft.images import is_image_file


@dataclass(frozen=True)
class ClipGroup:
    """The files of a group of clips.

    Args:
        folder (`Path`): the group's.
        clips (`list[Path]`): in natural order.
        mask (`MaskSource`, *optional*): `mask.*`, drawn on the first frames.
        mask_folders (`list[Path]`): with masks of single frames, called as `prepare` calls the frames.
        reference (`Path`, *optional*): the treated reference, if it is a photo.
        reference_time (`TimeInClip`, *optional*): if it is in a clip.
        facts (`dict`): of `group.yaml`.
    """

    folder: Path
    clips: list[Path]
    mask: MaskSource | None
    mask_folders: list[Path]
    reference: Path | None
    reference_time: TimeInClip | None
    facts: dict

    @property
    def files(self) -> list[Path]:
        """All that decides which frames are chosen, and what becomes of them."""
        masks = [path for folder in self.mask_folders for path in sorted(folder.iterdir()) if is_image_file(path)]
        others = [self.folder / name for name in GROUP_FILES]
        drawn = list(self.mask.files) if self.mask is not None else []
        return [
            *self.clips,
            *drawn,
            *masks,
            *([self.reference] if self.reference else []),
            *filter(Path.is_file, others),
        ]


def holds_clips(folder: Path) -> bool:
    """Whether a folder holds clips, and no photo but the treated reference. Raises as listing its files does."""
    files = list(files_below(folder))
    photos = [path for path in files if is_image_file(path) and not is_mask_file(path, folder)]
    return bool(find_clips(files)) and all(map(is_reference, photos))


def find_clip_group(folder: Path, root: Path) -> ClipGroup | None:
    """The group of clips in a folder, None if it holds photos, or no clips. Raises as reading its files does."""
    if not holds_clips(folder):
        return None
    files = sorted(files_below(folder))
    clips = [checked(path, root) for path in find_clips(files)]
    references = [path for path in files if is_image_file(path) and is_reference(path)]
    for name, count in Counter(path.stem for path in clips).items():
        if count > 1:
            raise ValueError(
                f"group {folder}: {count} clips are called {name}; their frames would be, too; rename one"
            )
    facts = read_facts(folder)
    time = read_time(facts["reference"], f"group {folder}: reference") if "reference" in facts else None
    if len(references) + (time is not None) > 1:
        stated = [*(path.name for path in references), *(["the time in group.yaml"] if time else [])]
        raise ValueError(f"group {folder}: two references, {' and '.join(stated[:2])}")
    mask = find_group_mask([path for path in files if is_group_mask(path)], clips[0], root, facts.get("mask_class"))
    reference = checked(references[0], root) if references else None
    return ClipGroup(folder, clips, mask, Listing().subfolders(folder, PICTURE_MASKS), reference, time, facts)
