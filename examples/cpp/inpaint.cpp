// RIFTCast's call beside the model's own: mends a picture by inpaint(image, mask).
//
//   inpaint MODEL.pt2 VIEW.safetensors OUT.safetensors
//
// VIEW holds the model's inputs by name (write_view.py writes one), and with them what a renderer hands over: `image`
// and `missing`, bottom-up. OUT holds `inpainted`, bottom-up too, 0 to 255.

#include "inpainting_module.h"

#include <iostream>

int main(int count, char** arguments) {
  if (count != 4) {
    std::cerr << "usage: inpaint MODEL.pt2 VIEW.safetensors OUT.safetensors\n";
    return 2;
  }
  try {
    InpaintingModule module(arguments[1]);
    Tensors given = read_tensors(arguments[2]);
    for (const char* name : {"image", "missing"})
      if (!given.count(name))
        throw std::runtime_error(std::string(arguments[2]) + ": expected the tensor " + name + ", got none; add it");
    const auto image = given.at("image"), missing = given.at("missing");
    module.observe(std::move(given));
    write_tensors(arguments[3], {{"inpainted", module.inpaint(image, missing).to(torch::kFloat)}});
  } catch (const std::exception& error) {
    std::cerr << "inpaint: " << error.what() << '\n';
    return 2;
  }
}
