# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Find boards
from kcal.corners.detect import detect_board as detect_board
from kcal.corners.detect import recognize_board as recognize_board
from kcal.corners.video import detect_video as detect_video
from kcal.corners.print_board import save_board as save_board

# Refine and match points
from kcal.corners.refine import RefineCorners as RefineCorners
from kcal.corners.saddle import CornerStatus as CornerStatus
from kcal.corners.match import refine_point as refine_point
from kcal.corners.match import match_points as match_points
from kcal.corners.match import MatchOptions as MatchOptions
from kcal.corners.match import MatchStatus as MatchStatus
