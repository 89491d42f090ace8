# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Read and match data
from kcal.calibrate.rig.pairs import pair_by_name as pair_by_name
from kcal.calibrate.rig.pairs import paired_boards as paired_boards
from kcal.locate.survey import import_survey as import_survey
from kcal.locate.survey import Survey as Survey
from kcal.locate.survey import match_landmarks as match_landmarks
from kcal.locate.survey import read_features as read_features
from kcal.scene.match import ImagePair as ImagePair
from kcal.scene.match import scene_features as scene_features
from kcal.calibrate.rig.source import Effect as Effect

# Skylines
from kcal.skyline.attitude import skyline_source as skyline_source
from kcal.skyline.attitude import skyline_attitude as skyline_attitude
from kcal.skyline.attitude import SkylineImage as SkylineImage
from kcal.skyline.horizon import RasterError as RasterError

# Things that move
from kcal.locate.moving import read_tracks as read_tracks
from kcal.locate.moving import read_sightings as read_sightings
from kcal.locate.moving import MovingOptions as MovingOptions
from kcal.locate.moving import match_moving as match_moving

# Place and plan rigs
from kcal.lens.rig import Mounting as Mounting
from kcal.lens.pair_errors import RigCovariance as RigCovariance
from kcal.locate.mounting import placed_rig as placed_rig
from kcal.locate.mounting import mounting_covariance as mounting_covariance
from kcal.locate.budget import planned_rig as planned_rig

# Any number of cameras
from kcal.locate.stations import station_rig as station_rig
from kcal.locate.stations import stated_mounting as stated_mounting

# Drift
from kcal.watch.watcher import Watched as Watched
from kcal.watch.turned import check_rig as check_rig
