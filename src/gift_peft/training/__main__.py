"""`accelerate launch -m gift_peft.training --config run.yaml`: `gift-peft train` on several processes."""

import sys

from gift_peft.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
