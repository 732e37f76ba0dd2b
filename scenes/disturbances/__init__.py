"""What a scene can carry without telling the estimator."""
