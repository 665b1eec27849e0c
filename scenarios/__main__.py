"""python -m scenarios: the same as the fleet-seif command."""

from scenarios.cli import main

main()
