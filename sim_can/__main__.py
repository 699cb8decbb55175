"""`python -m sim_can`: the same as `jtq sim`."""

from sim_can.cli import main

raise SystemExit(main())
