"""RoboTHOR object navigation: find an object of a class and stop where it is in view (Deitke et al., 2020)."""
