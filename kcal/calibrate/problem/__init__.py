"""What is minimized: board problems, priors, poses, closed-form starts, covariance."""
