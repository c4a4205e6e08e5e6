"""What somebody says of the pots. Imports nothing heavy, so that the command line can show its help quickly."""

from typing import Literal

Pots = Literal["auto", "fixed", "turned"]
