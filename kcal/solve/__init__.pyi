# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Least squares
from kcal.solve.lm import LevenbergMarquardt as LevenbergMarquardt
from kcal.solve.lm import LMOptions as LMOptions
from kcal.solve.result import SolverStatus as SolverStatus
from kcal.solve.robust import RobustLoss as RobustLoss
