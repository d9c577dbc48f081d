"""Linear estimation: QR factors, noise weights, residuals, M-estimation, recursion, selection."""
