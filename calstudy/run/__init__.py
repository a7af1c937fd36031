"""Tasks, their keys, the store of products, and their execution; knows no physics."""
