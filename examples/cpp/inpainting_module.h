// RIFTCast's call, answered by a model of `viewmend export --format pt2`: inpaint(image, mask), as its server makes it.
//
// That call hands over a picture and its holes alone. What this model looks at besides is told before, by `observe`.

#pragma once

#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

#include "tensor_file.h"

class InpaintingModule {
 public:
  // `bottom_up` is whether rows of images and masks begin at the bottom, as OpenGL reads them; those of `observe` do not.
  explicit InpaintingModule(const std::string& package, bool bottom_up = true)
      : model_(package), bottom_up_(bottom_up) {
    std::istringstream names(model_.get_metadata()["inputs"]);
    for (std::string name; std::getline(names, name, ',');) inputs_.push_back(name);
    if (inputs_.empty())
      throw std::runtime_error(package + ": expected a model of viewmend export, got another; export it again");
  }

  // Where the next pictures are taken from, and what the rig's cameras show: all inputs by name but `rgb` and `error`.
  void observe(Tensors seen) { seen_ = std::move(seen); }

  // The image with its holes completed. `image` is uint8 (height, width, 3 or more), `mask` float (height, width, 1), 1
  // where a pixel is missing; what comes back is uint8 (height, width, 3).
  torch::Tensor inpaint(const torch::Tensor& image, const torch::Tensor& mask) {
    torch::InferenceMode guard;
    const auto rgb = upright(image).slice(2, 0, 3).permute({2, 0, 1}).to(torch::kFloat) / 255;
    const auto holes = upright(mask).select(2, 0).to(torch::kFloat);
    std::vector<torch::Tensor> given;
    for (const std::string& name : inputs_) {
      if (name == "rgb") {
        given.push_back((rgb * (seen("weights").sum(0) > 0)).contiguous());  // black where no camera colours it
      } else {
        given.push_back(name == "error" ? holes.contiguous() : seen(name));
      }
    }
    const auto completed = torch::lerp(rgb, model_.run(given)[0], holes);
    const auto bytes = (completed.clamp(0, 1) * 255 + 0.5).to(torch::kUInt8).permute({1, 2, 0});
    return upright(bytes).contiguous();
  }

 private:
  torch::Tensor upright(const torch::Tensor& image) const { return bottom_up_ ? image.flip(0) : image; }

  const torch::Tensor& seen(const std::string& name) const {
    const auto found = seen_.find(name);
    if (found == seen_.end())
      throw std::runtime_error("expected the tensor " + name + " from observe(), got none; give all but rgb and error");
    return found->second;
  }

  torch::inductor::AOTIModelPackageLoader model_;
  bool bottom_up_;
  std::vector<std::string> inputs_;
  Tensors seen_;
};
