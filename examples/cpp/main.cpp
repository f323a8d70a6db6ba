// Mends one view with a model that `viewmend export --format pt2` wrote: no Python, no viewmend.
//
//   mend_view MODEL.pt2 VIEW.safetensors OUT.ppm [OUT.safetensors]
//
// VIEW holds the model's inputs by name (write_view.py writes one); OUT.ppm is the picture upon black, and
// OUT.safetensors all that the model tells: completed_rgb, alpha, confidence and completed_depth.

#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

#include <chrono>
#include <iostream>

#include "tensor_file.h"

namespace {

std::vector<std::string> split(const std::string& list) {
  std::vector<std::string> words;
  std::istringstream stream(list);
  for (std::string word; std::getline(stream, word, ',');) words.push_back(word);
  return words;
}

void write_picture(const std::string& path, const torch::Tensor& rgb) {
  const auto bytes = (rgb.clamp(0, 1) * 255 + 0.5).to(torch::kUInt8).permute({1, 2, 0}).contiguous();
  std::ofstream file(path, std::ios::binary);
  file << "P6\n" << bytes.size(1) << ' ' << bytes.size(0) << "\n255\n";
  file.write(static_cast<const char*>(bytes.data_ptr()), bytes.numel());
  if (!file.flush()) throw std::runtime_error(path + ": expected room for the picture; free some, or write elsewhere");
}

int mend(const std::vector<std::string>& paths) {
  torch::inductor::AOTIModelPackageLoader model(paths[0]);
  const auto told = model.get_metadata();
  if (!told.count("inputs") || !told.count("outputs"))
    throw std::runtime_error(paths[0] + ": expected a model of viewmend export, got another; export it again");
  const Tensors given = read_tensors(paths[1]);
  std::vector<torch::Tensor> inputs;
  for (const std::string& name : split(told.at("inputs"))) {
    if (!given.count(name)) throw std::runtime_error(paths[1] + ": expected the tensor " + name + ", got none; write it again");
    inputs.push_back(given.at(name));
  }
  torch::InferenceMode guard;
  const auto start = std::chrono::steady_clock::now();
  const auto outputs = model.run(inputs);
  const std::chrono::duration<double, std::milli> taken = std::chrono::steady_clock::now() - start;
  const auto names = split(told.at("outputs"));
  write_picture(paths[2], outputs[0]);
  if (paths.size() > 3) {
    Tensors completed;
    for (size_t n = 0; n < names.size(); ++n) completed[names[n]] = outputs[n];
    write_tensors(paths[3], completed);
  }
  std::cout << "completed " << outputs[1].size(1) << " x " << outputs[1].size(0) << " pixels by " << inputs[7].size(0)
            << " cameras in " << taken.count() << " ms; wrote " << paths[2] << '\n';
  return 0;
}

}  // namespace

int main(int count, char** arguments) {
  const std::vector<std::string> paths(arguments + 1, arguments + count);
  if (paths.size() < 3 || paths.size() > 4) {
    std::cerr << "usage: mend_view MODEL.pt2 VIEW.safetensors OUT.ppm [OUT.safetensors]\n";
    return 2;
  }
  try {
    return mend(paths);
  } catch (const std::exception& error) {
    std::cerr << "mend_view: " << error.what() << '\n';
    return 2;
  }
}
