"""The groups of an epoch, in its order, decoded and resized ahead of the step that needs them.

An epoch's order is a permutation of (seed, epoch) alone, so a resumed run skips what it has done for free. A group is
decoded and resized once (`cache.py`); threads prepare the next ones (Pillow, NumPy and PyTorch release the
interpreter lock), so that the step does not wait.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from gift_peft.dataset.cache import GroupCache
from gift_peft.dataset.tensors import Group


def epoch_order(num_groups: int, seed: int, epoch: int) -> list[int]:
    """A permutation of the groups that depends on its arguments alone."""
    state = int(np.random.SeedSequence((seed, epoch)).generate_state(1, np.uint64)[0])
    return torch.randperm(num_groups, generator=torch.Generator().manual_seed(state)).tolist()


class PreparedGroups:
    """Rows of GIFT-I as `Group`s of one size.

    Args:
        dataset: rows with proxies, as `load_gift_i(..., teacher=...)` gives them.
        processor, size: as for `collate_group`.
        num_threads: groups prepared ahead; 0 prepares each when it is asked for.
        cache_dir: of `GroupCache`; None decodes every time.
    """

    def __init__(
        self, dataset, processor, size: tuple[int, int], num_threads: int = 2, cache_dir: Path | None = None
    ) -> None:
        self.dataset = dataset
        self.num_threads = num_threads
        self._cache = GroupCache(dataset, processor, size, cache_dir)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Group:
        """Errors of `GroupCache.read`; ValueError if the row has no proxies."""
        group = self._cache.read(index)
        if group.target is None:
            raise ValueError(f"group {group.group_id} has no proxies")
        if torch.cuda.is_available():  # a pinned tensor travels while the device computes
            group.pixel_values = group.pixel_values.pin_memory()
        return group

    def take(self, indices: Iterable[int]) -> Iterator[Group]:
        """The groups of these indices, in this order; there may be infinitely many."""
        if self.num_threads == 0:
            yield from (self[index] for index in indices)
            return
        pool = ThreadPoolExecutor(self.num_threads, thread_name_prefix="groups")
        ahead: deque = deque()
        try:
            for index in indices:
                ahead.append(pool.submit(self.__getitem__, index))
                if len(ahead) > self.num_threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
