"""Schedules decide before each step its resolution and SH degree, and whether the model may grow.

Each is a `plan.Schedule` in its own file, with its options, defaults and presets. `sig` follows the
scene frequency, `constant` is that of 3DGS, `dash` and `taming` are the baselines of the SIG paper,
`mcmc` is one more.
Other packages register theirs (registry.py).
"""
