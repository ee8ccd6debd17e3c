"""GIFT-I: groups of images of one scene, as rows of a `datasets.Dataset`."""

from gift_peft.data.gift_i import FEATURES, GiftI, dataset_fingerprint, load_gift_i, register
from gift_peft.data.writer import write_gift_i

__all__ = ["FEATURES", "GiftI", "dataset_fingerprint", "load_gift_i", "register", "write_gift_i"]
