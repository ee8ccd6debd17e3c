"""The groups of an epoch, in its order, decoded and resized ahead of the step that needs them.

An epoch's order is a permutation of (seed, epoch) alone, so a resumed run skips what it has done for free. A group is
prepared once and kept at network size as far as the memory allows; threads prepare the next ones (Pillow and PyTorch
release the interpreter lock), so that the step does not wait for decoding.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch

from gift_peft.data.preprocess import Group, collate_group


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
        cache_bytes: groups are kept until this is used up.
    """

    def __init__(self, dataset, processor, size: tuple[int, int], num_threads: int = 2, cache_bytes: int = 0) -> None:
        self.dataset = dataset
        self.processor = processor
        self.size = size
        self.num_threads = num_threads
        self.room = cache_bytes
        self._cache: dict[int, Group] = {}

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Group:
        """Errors of `collate_group`; ValueError if the row has no proxies."""
        if index in self._cache:
            return self._cache[index]
        group = collate_group(self.dataset[index], self.processor, self.size)
        if group.target is None:
            raise ValueError(f"group {group.group_id} has no proxies")
        group = replace(group, depths=None)  # true depths are for evaluation and stay out of training
        size = sum(value.nbytes for value in vars(group).values() if isinstance(value, torch.Tensor))
        if size <= self.room:
            self.room -= size
            self._cache[index] = group
        return group

    def take(self, indices: Sequence[int]) -> Iterator[Group]:
        """The groups of these indices, in this order."""
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
