"""`python -m gift_peft`: the same as `gift-peft`."""

from gift_peft.cli import main

if __name__ == "__main__":
    main()
