"""Signed distance to the geoms of an object or of a link: computed beforehand, tabled in the Plan, measured at run time.

No quantity of its own: `contact_depth` and `points` are made of it.
"""
