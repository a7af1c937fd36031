"""One module per stage: files of the inputs' products in, files of the product out, physics from the other packages."""
