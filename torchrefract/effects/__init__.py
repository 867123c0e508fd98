"""Effects: modules that draw parameters by key and compute a degradation from them. See README.md to add one."""
