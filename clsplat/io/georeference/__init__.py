"""Where a scene lies on the earth: coordinate reference systems (CRS), the placing of
reconstructions by GPS and ground control points, and their files."""
