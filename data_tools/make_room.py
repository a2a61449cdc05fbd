"""Create a synthetic room without installation: `python data_tools/make_room.py --out DIR ...`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from toolkit.tools.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["make-room", *sys.argv[1:]]))
