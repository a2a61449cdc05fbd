"""`semsplat register` from a checkout: `python apps/register.py ...`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from toolkit.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["register", *sys.argv[1:]]))
