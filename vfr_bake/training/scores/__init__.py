"""Scores of pictures against photographs: PSNR, SSIM and LPIPS of a model's held-out views."""
