"""Reading and writing files: the only code with names and formats on disk.

Everything that is read comes from outside and is checked here: data that passes is finite, complete
and of the right shape, and other data raises `InputError` with one line that names the file, the
cause and the cure. Files are written beside their place and renamed, so that a killed process
leaves the old file or the new one.
"""
