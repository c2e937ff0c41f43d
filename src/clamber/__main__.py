"""`python -m clamber`: the command line where its script is not on the path."""

from clamber.cli import main

raise SystemExit(main())
