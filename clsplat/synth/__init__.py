"""A procedural city photographed by a drone: a scene whose true surfaces are known.

`layout` places the buildings, `geometry` has the solids, `texture` gives their colours as functions
of the surface point, `raycast` renders them, `cameras` plans the flight, `tracks` stands for an
ideal structure-from-motion, and `write` writes the scene folder. All surfaces are Lambertian, and
everything follows from one seed.
"""
