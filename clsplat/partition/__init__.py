"""A scene cut into blocks that are trained alone: where the cuts are, and who is given which view.

`make.make_partition` is the way in; its methods share one signature.
"""
