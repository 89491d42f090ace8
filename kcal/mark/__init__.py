"""Mark landmarks and targets in both images on a local web page (`kcal mark`), with the σ of each mark."""
