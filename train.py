"""`python train.py ...` is `mvseg train ...`; with torchrun, every process runs this file."""

import sys

from mvseg.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
