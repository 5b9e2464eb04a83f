"""One function for many parameters, here and on a cluster; formulations compared."""
