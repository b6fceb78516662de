// Touch without Python: runs a package that `tgdsl export hand.yaml --to aoti` wrote. CMakeLists.txt builds it.
//
//   touch hand.aoti.pt2 FOLDER NUM_ENVS NUM_CALLS
//
// The inputs of call i are raw numbers in FOLDER/i_<name>.bin; each output is written to FOLDER/<name>.bin, call after call.
// A slash in a name is an underscore in its file's. Memory is carried from call to call.
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

#include <fstream>
#include <iostream>
#include <map>
#include <regex>
#include <string>
#include <vector>

struct Port {
  std::string name;
  std::vector<int64_t> shape;  // after the environments
  torch::Dtype dtype;
  double rest;  // what memory holds before the first call
};

// Reads names, shapes and dtypes, in order, from one side of the text that tgdsl puts into the package.
std::vector<Port> ports(const std::string& text) {
  static const std::map<std::string, torch::Dtype> dtypes = {
      {"float32", torch::kFloat32}, {"float64", torch::kFloat64}, {"int64", torch::kInt64},
      {"int32", torch::kInt32},     {"bool", torch::kBool}};
  static const std::regex port(
      R"re("name":\s*"([^"]*)",\s*"shape":\s*\[([^\]]*)\],\s*"dtype":\s*"([^"]*)",\s*"rest":\s*([^\s}]*))re");
  static const std::regex number(R"(\d+)");
  std::vector<Port> result;
  for (std::sregex_iterator at(text.begin(), text.end(), port), end; at != end; ++at) {
    const std::string sizes = (*at)[2], rest = (*at)[4];
    std::vector<int64_t> shape;
    for (std::sregex_iterator n(sizes.begin(), sizes.end(), number), last; n != last; ++n) shape.push_back(std::stoll(n->str()));
    result.push_back({(*at)[1], shape, dtypes.at((*at)[3]), rest == "null" ? 0.0 : std::stod(rest)});
  }
  return result;
}

std::string file_of(const std::string& folder, std::string name) {
  for (char& c : name) c = c == '/' ? '_' : c;
  return folder + "/" + name + ".bin";
}

torch::Tensor read(const std::string& file, const std::vector<int64_t>& shape, torch::Dtype dtype) {
  torch::Tensor tensor = torch::empty(shape, dtype);
  std::ifstream in(file, std::ios::binary);
  in.read(static_cast<char*>(tensor.data_ptr()), static_cast<std::streamsize>(tensor.nbytes()));
  if (!in) throw std::runtime_error(file + ": too short, or not there");
  return tensor;
}

int main(int argc, char** argv) {
  if (argc != 5) {
    std::cerr << "touch PACKAGE FOLDER NUM_ENVS NUM_CALLS\n";
    return 2;
  }
  const std::string folder = argv[2];
  const int64_t num_envs = std::stoll(argv[3]), num_calls = std::stoll(argv[4]);
  c10::InferenceMode guard;
  torch::inductor::AOTIModelPackageLoader package(argv[1]);
  const std::string text = package.get_metadata().at("tgdsl");
  const size_t middle = text.find("\"outputs\"");
  const std::vector<Port> inputs = ports(text.substr(0, middle)), outputs = ports(text.substr(middle));

  std::map<std::string, torch::Tensor> memory;
  auto shape_of = [&](const Port& port) {
    std::vector<int64_t> shape = {num_envs};
    shape.insert(shape.end(), port.shape.begin(), port.shape.end());
    return shape;
  };
  for (const Port& port : inputs)
    if (port.name.rfind("memory/", 0) == 0) memory[port.name] = torch::full(shape_of(port), port.rest, port.dtype);

  std::map<std::string, std::ofstream> files;
  for (int64_t call = 0; call < num_calls; call++) {
    std::vector<torch::Tensor> given;
    for (const Port& port : inputs) {
      const auto kept = memory.find(port.name);
      given.push_back(kept != memory.end() ? kept->second
                                           : read(file_of(folder, std::to_string(call) + "/" + port.name), shape_of(port), port.dtype));
    }
    const std::vector<torch::Tensor> result = package.run(given);
    for (size_t i = 0; i < outputs.size(); i++) {
      const std::string& name = outputs[i].name;
      if (name.rfind("next/", 0) == 0) {
        memory["memory/" + name.substr(5)] = result[i];
        continue;
      }
      const torch::Tensor tensor = result[i].contiguous();
      std::ofstream& file = files.try_emplace(name, file_of(folder, name), std::ios::binary).first->second;
      file.write(static_cast<const char*>(tensor.data_ptr()), static_cast<std::streamsize>(tensor.nbytes()));
    }
  }
}
