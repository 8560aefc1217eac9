"""Earlier models of reconstruction from DIC: the weak specimen in 3-D, and the thin phase object by sections."""
