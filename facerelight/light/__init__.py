"""Where the light of a photograph is: the protocol of an estimator, the estimators, and amounts of many lights."""
