# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Least squares
from kcal.solve.lm import LevenbergMarquardt as LevenbergMarquardt
from kcal.solve.lm import LMOptions as LMOptions
from kcal.solve.lm import RobustLoss as RobustLoss
from kcal.solve.lm import SolverStatus as SolverStatus
