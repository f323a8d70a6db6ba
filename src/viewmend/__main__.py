"""`python -m viewmend`, for launchers such as torchrun."""

from viewmend.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
