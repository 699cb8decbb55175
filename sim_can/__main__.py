"""`python -m jtqd.sim_can`: the same as `jtq sim`."""

from jtqd.sim_can.command import main

raise SystemExit(main())
