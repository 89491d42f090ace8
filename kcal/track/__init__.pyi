# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# From a detector's boxes to pairs
from kcal.pipeline.detections import Detections as Detections
from kcal.pipeline.pairing import pair_objects as pair_objects
from kcal.pipeline.pairing import matched_pixels as matched_pixels
from kcal.pipeline.grouping import group_objects as group_objects
from kcal.pipeline.association import AssociationOptions as AssociationOptions
from kcal.pipeline.association import PairBoxes as PairBoxes
from kcal.pipeline.pairing import ObjectDisparity as ObjectDisparity
from kcal.pipeline.pairing import DisparityOptions as DisparityOptions

# Tracks
from kcal.pipeline.tracks import Tracker as Tracker
from kcal.pipeline.tracks import TrackOptions as TrackOptions
from kcal.pipeline.imm_filter import Motion as Motion
from kcal.pipeline.measurements import ClockPrior as ClockPrior
