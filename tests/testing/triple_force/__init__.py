"""A force sensor with three axes in mN: lines of three numbers at a rate of one's choice."""
