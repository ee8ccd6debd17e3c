"""What a person says of a group in its `group.yaml`."""

from pathlib import Path

from gift_peft.captures.clip import read_time
from gift_peft.files import read_yaml
from gift_peft.rules import SURFACES

GROUP_KEYS = {"surface", "notes", "mask_class", "empty_masks", "static_rig", "synthesized", "reference"}
GROUP_FILES = ("group.yaml", "group.yml")
EMPTY_MASKS = ("refuse", "allow")  # a photo without a target in a group whose others have one


def read_facts(folder: Path) -> dict:
    """What `group.yaml` says, {} without one; ValueError naming the file and what is wrong."""
    found = [folder / name for name in GROUP_FILES if (folder / name).exists()]
    if not found:
        return {}
    if len(found) > 1:
        raise ValueError(f"{found[0]} and {found[1].name}: one of them is enough; remove the other")
    path = found[0]
    facts = read_yaml(path)
    if not facts.keys() <= GROUP_KEYS:
        raise ValueError(f"{path}: it may have the keys {', '.join(sorted(GROUP_KEYS))} and no others")
    if facts.get("surface") is not None:
        facts["surface"] = str(facts["surface"]).lower()
    if facts.get("surface") not in (None, *SURFACES):
        raise ValueError(f"{path}: surface {facts['surface']!r}; it is one of {', '.join(SURFACES)}")
    classes = facts.get("mask_class", [])
    for value in classes if isinstance(classes, list) else [classes]:
        if isinstance(value, bool) or not isinstance(value, int | str):
            what = "the target's value or label in the masks, or a list; yes, no, on and off need quotes"
            raise ValueError(f"{path}: mask_class {classes!r}; it is {what}")
    if facts.get("empty_masks", "refuse") not in EMPTY_MASKS:
        raise ValueError(f"{path}: empty_masks {facts['empty_masks']!r}; it is one of {', '.join(EMPTY_MASKS)}")
    if not isinstance(facts.get("static_rig", False), bool):
        raise ValueError(f"{path}: static_rig {facts['static_rig']!r}; it is true or false")
    if "reference" in facts:
        read_time(facts["reference"], f"{path}: reference")
    if not isinstance(facts.get("synthesized", {}), dict):
        raise ValueError(f"{path}: synthesized {facts['synthesized']!r}; it is what gift-peft synthesize wrote there")
    return facts
