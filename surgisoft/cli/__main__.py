"""`python -m surgisoft.cli`, the name of before for `python -m surgisoft`."""

from surgisoft.cli import main

if __name__ == "__main__":
    main()
