"""Calibrated photos and masks in, the same leaf with the same id in every view and in 3D out: `mvseg infer`."""

import sys

from mvseg.cli import main

if __name__ == "__main__":
    sys.exit(main(["infer", *sys.argv[1:]]))
