"""Parallel primitives over device arrays: compaction, sort, gather, reduce.

They know nothing of splats. Each function allocates what it returns; temporary memory comes from
the device's pool.
"""
