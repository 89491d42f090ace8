"""The learned inverse of a lens (Eq. 12 of the paper), with its network and fit."""
