"""The groups of an epoch, in its order, decoded and resized ahead of the step that needs them.

An epoch's order is a permutation of (seed, epoch) alone, so a resumed run skips what it has done for free. A group is
decoded and resized once (`cache.py`); threads prepare the next ones (Pillow, NumPy and PyTorch release the
interpreter lock), so that the step does not wait.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from gift_peft.dataset.cache import GroupCache
from gift_peft.dataset.light import in_light
from gift_peft.dataset.tensors import Group
from gift_peft.rules import UNKNOWN

Item = TypeVar("Item")


def epoch_order(num_groups: int, seed: int, epoch: int) -> list[int]:
    """A permutation of the groups that depends on its arguments alone."""
    state = int(np.random.SeedSequence((seed, epoch)).generate_state(1, np.uint64)[0])
    return torch.randperm(num_groups, generator=torch.Generator().manual_seed(state)).tolist()


def epoch_flips(num_images: int, seed: int, epoch: int) -> list[bool]:
    """Which images of an epoch are shown as in a mirror, one in two; depends on its arguments alone."""
    return np.random.default_rng((seed, epoch)).integers(2, size=num_images).astype(bool).tolist()


class PreparedGroups:
    """Rows of GIFT-I as `Group`s of one size.

    Args:
        dataset: rows with proxies, as `load_gift_i(..., teacher=...)` gives them.
        processor, size: as for `collate_group`.
        num_threads: groups prepared ahead; 0 prepares each when it is asked for.
        cache_dir: of `GroupCache`; None decodes every time.
        pin: into pinned memory, from where tensors travel to a CUDA device while the host goes on.
    """

    def __init__(
        self,
        dataset,
        processor,
        size: tuple[int, int],
        num_threads: int = 2,
        cache_dir: Path | None = None,
        pin: bool = False,
    ) -> None:
        self.dataset = dataset
        self.image_names: list[list[str]] = dataset["image_names"][:]
        self.processor = processor
        self.num_threads = num_threads
        self.pin = pin
        self.cache = GroupCache(dataset, processor, size, cache_dir)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Group:
        """Errors of `GroupCache.read`; ValueError if the row has no proxies."""
        group = self.cache.read(index)
        if group.target is None:
            raise ValueError(f"group {group.group_id} has no proxies")
        return self.pinned(group)

    def pinned(self, group: Group) -> Group:
        """The same, its tensors in pinned memory if that is asked for: last, since what is made of them is not."""
        if self.pin:
            for name in ("pixel_values", "mask", "valid", "target", "surface_target"):
                if (tensor := getattr(group, name)) is not None:
                    setattr(group, name, tensor.pin_memory())
        return group

    def take(self, indices: Iterable[int]) -> Iterator[Group]:
        """The groups of these indices, in this order; there may be infinitely many."""
        return read_ahead(self.__getitem__, indices, self.num_threads)


class PreparedImages:
    """The images of groups, one by one: groups of one, with their surface targets.

    Of a group in the cache only this image is read; without a cache each image decodes its whole group.

    Args:
        groups: of rows with surface targets, as `load_gift_i(..., teacher=..., surface=...)` gives them.
    """

    def __init__(self, groups: PreparedGroups) -> None:
        self.groups = groups
        self.num_threads = groups.num_threads
        counts = map(len, groups.image_names)
        self._places = [(row, image) for row, count in enumerate(counts) for image in range(count)]

    def __len__(self) -> int:
        return len(self._places)

    def read(self, index: int, flip: bool = False, light: np.ndarray | None = None) -> Group:
        """One image, called `<group>/<image>`, or its mirror image; `surface_target` is that of what is shown.

        `light`: (5,), the factors of `in_light` by which it is shown in another light.
        Errors of `GroupCache.read`; ValueError if the row has no surface targets.
        """
        image = self.groups.cache.read(*self._places[index])
        if image.surface_target is None:
            raise ValueError(f"group {image.group_id} has no surface targets")
        image.names = [f"{image.group_id}/{name}" for name in image.names]
        if flip:
            image.pixel_values, image.mask = image.pixel_values.flip(-1), image.mask.flip(-1)
            image.valid = None if image.valid is None else image.valid.flip(-1)
            image.surface_target = image.surface_target_flipped
        if light is not None:
            image.pixel_values = in_light(image.pixel_values, light[None], self.groups.processor)
        image.surface_target_flipped = None
        if (unknown := image.surface_target == UNKNOWN).any():  # as with the proxies of whole groups
            image.valid = ~unknown if image.valid is None else image.valid & ~unknown
            image.surface_target = image.surface_target.masked_fill(unknown, 0)
        return self.groups.pinned(image)

    def take(self, items: Iterable[tuple[int, bool, np.ndarray | None]]) -> Iterator[Group]:
        """`read` of these (index, flip, light), in this order; there may be infinitely many."""
        return read_ahead(lambda item: self.read(*item), items, self.num_threads)


def read_ahead(read: Callable[[Item], Group], items: Iterable[Item], num_threads: int) -> Iterator[Group]:
    """`read(item)` of each item, in their order, so many of them prepared before they are asked for."""
    if num_threads == 0:
        yield from map(read, items)
        return
    pool = ThreadPoolExecutor(num_threads, thread_name_prefix="groups")
    ahead: deque = deque()
    try:
        for item in items:
            ahead.append(pool.submit(read, item))
            if len(ahead) > num_threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
