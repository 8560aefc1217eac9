"""A proximal Newton method: the weak specimen's Hessian, and priors that have corners."""
