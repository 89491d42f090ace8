# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Positions
from kcal.locate.marks import read_marks as read_marks
from kcal.locate.marks import Marks as Marks
from kcal.locate.export import write_positions as write_positions

# Triangulation of rays
from kcal.locate.angular import triangulate as triangulate

# Ranges from disparities
from kcal.locate.disparity import DisparityRanges as DisparityRanges

# Points on the ground
from kcal.locate.ground import level_ground as level_ground
from kcal.locate.ground import terrain as terrain

# Where to put the next camera
from kcal.locate.siting import area_of as area_of
from kcal.locate.siting import Site as Site
from kcal.locate.siting import rank_sites as rank_sites

# Geodesy
from kcal.lens.pose import enu_from_cam as enu_from_cam
from kcal.locate.geodesy import enu_to_geodetic as enu_to_geodetic
from kcal.locate.geodesy import geodetic_to_enu as geodetic_to_enu
from kcal.locate.tabulate import find_geoid as find_geoid

# Range errors of a rig
from kcal.locate.budget import range_errors as range_errors
from kcal.locate.budget import BudgetErrors as BudgetErrors
from kcal.locate.budget import check_ranges as check_ranges
