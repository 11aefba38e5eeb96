"""`python -m surgisoft`: the command line, also for torchrun."""

from surgisoft.cli import main

if __name__ == "__main__":
    main()
