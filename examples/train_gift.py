"""GIFT on your own groups of images: a depth model in, an adapter out. The loop itself is `gift_peft.training.loop`.

    accelerate launch examples/train_gift.py --config examples/depth_anything_v2_large.yaml --dataset_name my-gift-i

Values in the YAML file are overridden by the command line; `--help` lists them all. Without a checkout of this file:
`accelerate launch -m gift_peft.training`, or on one device `gift-peft train`.
"""

import sys

from gift_peft.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
