"""A made-up city, photographed by a pretended drone: a scene whose true surfaces are known.

All surfaces are Lambertian, and everything follows from one seed.
"""
