# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Find and name stars
from kcal.stars.detect import detect_stars as detect_stars
from kcal.stars.night import name_stars as name_stars

# Catalog and sky
from kcal.stars.night import SkyView as SkyView
from kcal.stars.sky import StarCatalog as StarCatalog
from kcal.stars.sky import Air as Air

# What rigs are solved from
from kcal.stars.rig_stars import star_source as star_source

# Lenses, and what to expect
from kcal.stars.lens import calibrate_by_stars as calibrate_by_stars
