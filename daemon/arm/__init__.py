"""What pushes on an arm: `jtqd-arm`, a reader of running jtqd. Pure: `estimator` and what it imports."""
