# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Residual
from kcal.nets.joint import ResidualNet as ResidualNet

# Residual field of a camera
from kcal.lens.field_modes import NetworkModes as NetworkModes
from kcal.calibrate.hybrid.network_fit import FieldTraining as FieldTraining

# Inverse
from kcal.nets.inverse import InverseNet as InverseNet
from kcal.nets.inverse import train_inverse as train_inverse
from kcal.nets.inverse import InverseNetOptions as InverseNetOptions

# Residual and inverse together
from kcal.nets.joint import train_jointly as train_jointly
from kcal.nets.joint import JointOptions as JointOptions
