"""Files in and out: the only code that knows names and formats on disk.

Everything read here comes from outside and is checked here: what passes is finite, complete and
of the right shape, and what does not raises `InputError` with one line that names the file, the
cause and the cure. Files are written beside and renamed, so that a killed process leaves the old
file or the new one.
"""
