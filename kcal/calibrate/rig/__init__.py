"""Several cameras: from boards, landmarks and features to a rig with a joint covariance."""
