"""`python -m surgisoft.cli`, for torchrun."""

from surgisoft.cli import main

main()
