"""Plane sweep in a target's frustum: what photos show, carried to where it is wanted."""
