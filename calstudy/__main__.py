"""``python -m calstudy``."""

import sys

# Python puts the working folder first, whose signal.py would be taken for its own; workers of a checkout need theirs.
if not sys.flags.safe_path and not __file__.startswith(f"{sys.path[0]}/"):
    del sys.path[0]

from calstudy.cli.main import main

if __name__ == "__main__":
    main()
