"""Where a scene lies on the earth and which way it stands: the up axis, the first view of a viewer,
the alignment of a reconstruction with GPS and ground control points. All functions take arrays."""
