"""`python -m tgdsl`."""

from tgdsl.commands.cli import main

main()
