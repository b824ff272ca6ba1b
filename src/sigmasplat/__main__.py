"""Run the command line: python -m sigmasplat is the same program as sigmasplat."""

from sigmasplat.cli import main

if __name__ == "__main__":
    main()
