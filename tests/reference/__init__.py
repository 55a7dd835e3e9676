"""Every kernel family again in plain float64 numpy: the oracle of the kernel tests.

Imports numpy only and shares no code with clsplat, so that one mistake cannot hide in both.
"""
