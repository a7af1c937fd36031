"""``python -m calstudy``."""

from calstudy.cli.main import main

if __name__ == "__main__":
    main()
