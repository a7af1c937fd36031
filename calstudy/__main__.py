"""``python -m calstudy``."""

import sys

# Python puts the working folder first, whose signal.py would be taken for its own; workers of a checkout need theirs.
if not sys.flags.safe_path and __file__ != f"{sys.path[0]}/calstudy/__main__.py":
    del sys.path[0]

from calstudy.cli.main import main

if __name__ == "__main__":
    main()
