"""GenICam cameras by the names of their features, through any library that reaches them."""
