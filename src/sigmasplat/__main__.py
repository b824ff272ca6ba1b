"""Run the command line: python -m sigmasplat, the same as sigmasplat."""

from sigmasplat.cli import main

if __name__ == "__main__":
    main()
