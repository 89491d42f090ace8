"""Mark landmarks and targets in both images on a local web page (`kcal mark`), and tell what each mark is worth."""
