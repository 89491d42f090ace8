# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Find and name stars
from kcal.stars.detect import detect_stars as detect_stars
from kcal.stars.detect import DetectedStars as DetectedStars
from kcal.stars.sky import identify as identify
from kcal.stars.sky import Identification as Identification
from kcal.stars.night import name_stars as name_stars
from kcal.stars.night import NamedStars as NamedStars
from kcal.stars.night import Attitude as Attitude
from kcal.stars.night import clock_doubts as clock_doubts

# Catalogue and sky
from kcal.stars.sky import StarCatalog as StarCatalog
from kcal.stars.night import SkyView as SkyView
from kcal.stars.sky import Air as Air
from kcal.stars.sky import observed_directions as observed_directions
from kcal.stars.sky import celestial_directions as celestial_directions
from kcal.stars.sky import parse_time as parse_time

# What rigs are solved from
from kcal.stars.rig_stars import star_source as star_source
from kcal.stars.rig_stars import moments_of as moments_of
from kcal.calibrate.rig.sources import StarSource as StarSource

# Lenses, and what to expect
from kcal.stars.lens import calibrate_by_stars as calibrate_by_stars
from kcal.stars.lens import StarCamera as StarCamera
from kcal.stars.lens_fit import StarLens as StarLens
from kcal.stars.lens import Agreement as Agreement
from kcal.stars.detect import planned_stars as planned_stars
from kcal.stars.detect import NightPlan as NightPlan
from kcal.stars.detect import PlannedStars as PlannedStars
