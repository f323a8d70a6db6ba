"""Image quality: PSNR, SSIM, LPIPS and VFID."""
