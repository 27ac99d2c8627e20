"""The material card of a tensile test: modulus, Poisson's ratio, proof stress and what else a standard asks for."""
