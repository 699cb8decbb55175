"""A foreign arm to judge external torque by: plant, trial, judge, baseline; none of it imports estimator/ or daemon/."""
