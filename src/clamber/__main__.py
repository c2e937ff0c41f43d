"""`clamber` and `python -m clamber`: the command line, interrupted at any time."""

import signal
import sys


def main() -> int:
    """Load and run the command line, and return its exit code."""
    try:
        from clamber.cli import main as run

        return run()
    except KeyboardInterrupt:  # while it was loaded: it minds its own
        sys.stderr.write("clamber: interrupted; nothing was written\n")
        return 130
    finally:  # all is said: what is left ends at once, without a traceback
        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    raise SystemExit(main())
