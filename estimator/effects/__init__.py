"""The effect library: physical deviations of a joint from the rigid textbook, one file each."""
