"""The command line: one file a command, which parses, calls and prints.

The only package that imports click. Commands import what they run inside their function, because
`clsplat --help` must not wait for numpy, pycolmap or an OpenCL driver.
"""
