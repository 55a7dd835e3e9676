"""A procedural city photographed by a drone: a scene whose true surfaces are known.

`layout` places blocks, `geometry` holds the solids, `texture` paints them as functions of the
surface point, `raycast` renders them, `cameras` flies the survey, `tracks` is the ideal
structure-from-motion, and `write` puts the scene folder together. Everything is Lambertian and
made from one seed.
"""
