"""What is learned from many people: the statistics, how they are learned, kept on disk, and the covariances that
follow."""
