"""Run the command line as `python -m rotflex_jax`."""

from rotflex_jax.cli import main

if __name__ == "__main__":
    main()
