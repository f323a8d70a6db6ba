// Tensors by name in a safetensors file: eight bytes with the length of a head, the head in JSON, then the numbers.
#pragma once

#include <torch/torch.h>

#include <cstdint>
#include <cstring>
#include <fstream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Tensors = std::map<std::string, torch::Tensor>;

const std::map<std::string, torch::ScalarType> kTypes = {
    {"F32", torch::kFloat32}, {"I64", torch::kInt64}, {"U8", torch::kUInt8}, {"BOOL", torch::kBool}};

// Reads the head of the file and nothing beyond what such a head may hold: objects, lists of whole numbers, texts.
class HeadReader {
 public:
  HeadReader(std::string head, std::string path) : head_(std::move(head)), path_(std::move(path)) {}

  bool next(char wanted) {  // whether this character follows; it is taken if it does
    while (at_ < head_.size() && std::isspace(static_cast<unsigned char>(head_[at_]))) ++at_;
    if (at_ >= head_.size() || head_[at_] != wanted) return false;
    ++at_;
    return true;
  }

  void demand(char wanted) {
    if (!next(wanted)) fail(std::string("'") + wanted + "' in its head");
  }

  std::string text() {
    demand('"');
    const size_t end = head_.find('"', at_);
    if (end == std::string::npos) fail("a text that ends");
    const std::string found = head_.substr(at_, end - at_);
    if (found.find('\\') != std::string::npos) fail("texts without escapes");
    at_ = end + 1;
    return found;
  }

  std::vector<int64_t> numbers() {
    std::vector<int64_t> found;
    demand('[');
    while (!next(']')) {
      if (!found.empty()) demand(',');
      size_t used = 0;
      try {
        found.push_back(std::stoll(head_.substr(at_, 20), &used));
      } catch (const std::exception&) {
        fail("whole numbers in its lists");
      }
      at_ += used;
    }
    return found;
  }

  [[noreturn]] void fail(const std::string& wanted) const {
    throw std::runtime_error(path_ + ": expected a safetensors file with " + wanted + "; write it again");
  }

 private:
  std::string head_, path_;
  size_t at_ = 0;
};

inline Tensors read_tensors(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + ": expected a file that can be read, got none; check the path");
  std::ostringstream all;
  all << file.rdbuf();
  const std::string bytes = all.str();
  uint64_t length = 0;
  if (bytes.size() >= 8) std::memcpy(&length, bytes.data(), 8);
  if (bytes.size() < 8 || length > bytes.size() - 8) HeadReader("", path).fail("a whole head");
  HeadReader head(bytes.substr(8, length), path);
  const char* data = bytes.data() + 8 + length;
  const int64_t size = static_cast<int64_t>(bytes.size() - 8 - length);
  Tensors tensors;
  head.demand('{');
  for (bool begins = true; !head.next('}'); begins = false) {
    if (!begins) head.demand(',');
    const std::string name = head.text();
    std::string type;
    std::vector<int64_t> shape, range;
    head.demand(':');
    head.demand('{');
    if (name == "__metadata__") {  // texts by name
      for (bool first = true; !head.next('}'); first = false) {
        if (!first) head.demand(',');
        head.text();
        head.demand(':');
        head.text();
      }
      continue;
    }
    for (bool first = true; !head.next('}'); first = false) {
      if (!first) head.demand(',');
      const std::string key = head.text();
      head.demand(':');
      if (key == "dtype") type = head.text();
      else if (key == "shape") shape = head.numbers();
      else if (key == "data_offsets") range = head.numbers();
      else head.fail("dtype, shape and data_offsets alone");
    }
    if (!kTypes.count(type)) head.fail("F32, I64, U8 or BOOL for " + name);
    const auto kind = kTypes.at(type);
    int64_t wanted = static_cast<int64_t>(torch::elementSize(kind));
    for (const int64_t length_of_axis : shape) {
      if (length_of_axis < 0 || length_of_axis > size) head.fail("a shape that fits it for " + name);
      if (__builtin_mul_overflow(wanted, length_of_axis, &wanted)) head.fail("a shape that fits it for " + name);
    }
    if (range.size() != 2 || range[0] < 0 || range[0] > size || range[1] > size || range[1] - range[0] != wanted)
      head.fail("the numbers of " + name);
    tensors[name] = torch::empty(shape, kind);
    std::memcpy(tensors[name].data_ptr(), data + range[0], static_cast<size_t>(wanted));
  }
  return tensors;
}

inline void write_tensors(const std::string& path, const Tensors& tensors) {  // of 32-bit floats
  std::ostringstream head;
  int64_t begin = 0;
  for (const auto& [name, tensor] : tensors) {
    std::ostringstream shape;
    for (const int64_t length : tensor.sizes()) shape << (shape.tellp() ? "," : "") << length;
    const int64_t end = begin + tensor.numel() * 4;
    head << (begin ? "," : "{") << '"' << name << "\":{\"dtype\":\"F32\",\"shape\":[" << shape.str()
         << "],\"data_offsets\":[" << begin << ',' << end << "]}";
    begin = end;
  }
  std::string text = head.str() + "}";
  text.resize((text.size() + 7) / 8 * 8, ' ');
  const uint64_t length = text.size();
  std::ofstream file(path, std::ios::binary);
  file.write(reinterpret_cast<const char*>(&length), 8) << text;
  for (const auto& [name, tensor] : tensors)
    file.write(static_cast<const char*>(tensor.contiguous().data_ptr()), tensor.numel() * 4);
  if (!file.flush()) throw std::runtime_error(path + ": expected room for the file; free some, or write elsewhere");
}
