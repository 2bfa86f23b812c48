"""What benchmarks and tests share and users do not need; no part of the package."""
