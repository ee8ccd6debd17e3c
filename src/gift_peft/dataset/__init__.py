"""GIFT-I: groups of images as rows of a `datasets.Dataset`, with their proxies, and ready for the network."""
