"""`python -m surgisoft.cli`, the former name of `python -m surgisoft`."""

from surgisoft.cli import main

if __name__ == "__main__":
    main()
