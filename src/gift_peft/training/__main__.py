"""`gift-peft train`, also for launchers: `accelerate launch -m gift_peft.training --config run.yaml`."""

import sys
from collections.abc import Sequence

from gift_peft.options import run_verb
from gift_peft.training.arguments import make_parser, parse_arguments

__all__ = ["make_parser", "run"]


def run(argv: Sequence[str]) -> int:
    words = [word for word in argv if word.replace("_", "-") != "--dry-run"]
    arguments = parse_arguments(words)
    if len(words) < len(argv):
        from gift_peft.training.dry_run import dry_run

        return dry_run(arguments)
    from gift_peft.training.loop import train  # after the arguments are known to be right: this takes seconds

    result = train(arguments)
    return 128 + result.signal if result.signal else 0


if __name__ == "__main__":
    sys.exit(run_verb(run, sys.argv[1:]))
