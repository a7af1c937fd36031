"""``python -m calstudy``."""

from calstudy.cli import main

if __name__ == "__main__":
    main()
