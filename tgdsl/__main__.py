"""`python -m tgdsl`."""

from tgdsl.cli import main

main()
